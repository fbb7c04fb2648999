"""The commands `synth ...`: scenes and training pairs with a known truth."""
