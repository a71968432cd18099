"""RGB-D camera tracking in neural scene representations: a reproducible paper package."""

__version__ = "0.1.0"
