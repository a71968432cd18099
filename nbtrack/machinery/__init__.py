"""What any program needs: errors, settings, files, checks of input, progress, and the
device's use."""
