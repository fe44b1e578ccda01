"""Terms: plain functions on batched views."""
