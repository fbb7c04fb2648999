"""The steps of the flow, in its order: each reads folders, calls one stage and writes one folder."""
