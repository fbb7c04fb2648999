"""The state of an edited project: its edits with undo, its scenes and its files."""
