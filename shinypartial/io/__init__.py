"""Files, pictures, progress, memory and threads. Imports core."""
