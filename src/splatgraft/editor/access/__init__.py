"""Access to the editor's server: which requests are accepted, and which window edits."""
