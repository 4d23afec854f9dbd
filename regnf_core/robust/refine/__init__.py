"""Refinement of pose candidates on the fields: Levenberg-Marquardt on Sim(3)."""
