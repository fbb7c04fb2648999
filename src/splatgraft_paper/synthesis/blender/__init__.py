"""Programs for Blender's Python interpreter (bpy and numpy only), run in a process of their own."""
