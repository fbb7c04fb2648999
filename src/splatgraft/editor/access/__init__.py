"""Access to the editor's server: which requests are accepted, which window edits, which uploads are stored."""
