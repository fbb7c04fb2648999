"""Long work that the editor starts: child processes, exports, videos."""
