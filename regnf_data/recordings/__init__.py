"""Recordings: depth images with cameras and poses, as sensors, data sets and trainers leave them, in one type."""

from regnf_data.recordings.camera import Camera
from regnf_data.recordings.opening import Given, open_recording
from regnf_data.recordings.recording import Frame, Recording, StoredFrame

__all__ = ["Camera", "Frame", "Given", "Recording", "StoredFrame", "open_recording"]
