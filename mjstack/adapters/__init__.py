"""An `Env` in the interfaces of reinforcement learning libraries, one module each.

Nothing is imported here, because the libraries are the extra ``train``: import
``mjstack.adapters.gymnasium`` or ``mjstack.adapters.rsl_rl``.
"""
