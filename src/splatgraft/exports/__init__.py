"""Exports: files of a scene for other programs, pictures, videos, and HTML pages."""
