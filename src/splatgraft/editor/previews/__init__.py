"""Pictures of the scene while it is edited: full and draft renders and relighting."""
