"""Captures whose poses came along: COLMAP models, transforms.json, RGB-D sequences."""
