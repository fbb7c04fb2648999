"""The editor's page, built with viser."""
