"""The state of a project while it is edited: placement, selection and light, with undo."""
