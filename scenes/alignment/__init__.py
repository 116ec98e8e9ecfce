"""Alignment: floor, metric scale, wall directions and extent turn a model into metres, z up."""
