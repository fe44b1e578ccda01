"""Benchmarks: what the throughput gate and the scripts measure, and with what."""
