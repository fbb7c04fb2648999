"""The kinds of files that are accepted as uploads, and the check of one that has arrived."""

from pathlib import Path

from splatgraft.capture import read_video_facts
from splatgraft.formats import SCENE_SUFFIXES, read_gaussians

SCENES = SCENE_SUFFIXES
VIDEOS = (".mp4", ".mov", ".mkv", ".avi", ".webm")
SUFFIXES = (*SCENES, *VIDEOS)


def check_file(path: Path) -> None:
    """Read a scene, or the first frame of a video.

    Raises:
        ValueError: If it cannot be read.
    """
    if path.suffix.lower() in SCENES:
        read_gaussians(path)
    else:
        read_video_facts(path)
