"""What any program needs: errors, settings, files, text files, checks of input, progress, and the
device's use."""
