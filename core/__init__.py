"""Common ground of all packages: cameras, rotations, files, progress, logs, pages."""
