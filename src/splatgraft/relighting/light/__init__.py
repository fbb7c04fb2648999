"""The light at a place of a scene: its representation, the evidence for it, and the estimate."""
