"""The program that runs pycolmap (its only importer) in a process of its own: features, matches, poses and points.

A process of its own, since pycolmap's bundled zlib corrupts the heap of one that also loads Pillow, and since its C++
checks end the process. Of its modules, other code may import `job` alone.
"""
