"""Program that runs pycolmap in a process of its own: features, matches, poses and points.

It is the only importer of pycolmap. Two reasons keep it out of the main process: pycolmap's bundled zlib corrupts the
heap of a process that also loads Pillow, and its C++ checks end the process. Other code may only import `job`.
"""
