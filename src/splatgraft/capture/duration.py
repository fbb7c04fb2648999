"""Predicts how long structure from motion takes."""

_SECONDS_PER_PHOTO = 2.5
"""On two idle cores: 73 photos of 800 px took 3 minutes."""


def predict_pose_seconds(photos: int) -> float:
    """Seconds in which photos get poses on two idle cores, half or twice that; a second, thorough attempt apart."""
    return _SECONDS_PER_PHOTO * photos
