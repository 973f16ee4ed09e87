"""What this machine can run: compiled kernels, threads, memory, optional packages."""
