"""Benchmarks: the measurements of gate *throughput*."""
