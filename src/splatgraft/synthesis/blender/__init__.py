"""Code that runs inside Blender's Python (bpy and numpy only) and is started as a process of its own."""
