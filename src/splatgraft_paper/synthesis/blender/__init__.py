"""Code that runs in Blender's Python interpreter (bpy and numpy only), in a process of its own."""
