"""Who may use the editor, who may edit, and what may be uploaded."""
