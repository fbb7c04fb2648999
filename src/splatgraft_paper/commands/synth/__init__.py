"""The commands `synth ...`, one file each: synthetic training pairs and benchmark scenes."""
