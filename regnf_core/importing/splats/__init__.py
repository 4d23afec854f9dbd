"""Gaussian splats: their files, the depths that cameras see of them, and a map fused from these."""
