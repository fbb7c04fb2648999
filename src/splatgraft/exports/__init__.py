"""Scenes, pictures and pages for other programs and other people."""
