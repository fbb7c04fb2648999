"""Weights of networks: the table of all models, where their files are kept, and how they are fetched and checked."""
