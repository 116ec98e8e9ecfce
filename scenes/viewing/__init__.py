"""A scene in the browser: a bundle, a field that is trained, an override file that is clicked."""
