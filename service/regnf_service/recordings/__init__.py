"""Recordings: files of frames, or one frame in parts, and the frames' pictures."""
