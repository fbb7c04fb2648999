"""Other people's methods behind the same protocol; each says in one line what it misses. None is loaded by itself."""
