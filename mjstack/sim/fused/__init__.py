"""MJWarp's physics step in a few kernels of C++, where they do all that a model needs. In all
modules ``m`` is the uploaded model, and ``d`` are the worlds.
"""
