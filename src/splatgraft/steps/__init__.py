"""The steps of a project, one file each: a step reads folders, calls one stage and writes one folder."""
