"""Files, pictures, progress and threads. Imports core."""
