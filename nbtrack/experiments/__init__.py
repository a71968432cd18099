"""Experiments: methods, presets, jobs, and the commands that run them."""
