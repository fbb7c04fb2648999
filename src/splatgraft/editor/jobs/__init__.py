"""Jobs in child processes, and exports of results."""
