"""What any program needs: errors, settings, files, text files, progress, and the device's use."""
