"""Export: a scene bundle in the formats of other programs (MJCF, glTF, USD, splats, nerfstudio)."""
