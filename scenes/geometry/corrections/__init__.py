"""Corrections of depth: surfaces moved where pictures show that they must be."""
