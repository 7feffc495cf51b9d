"""Episode files, what is cached of them, and training batches."""
