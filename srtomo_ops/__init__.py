"""What people do with srtomo: the command line, the demo, benchmarks."""
