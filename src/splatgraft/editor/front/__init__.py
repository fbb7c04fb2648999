"""The front server: several projects behind one port, with TLS and a reverse proxy's address, and their start page."""
