"""An `Env` in the interfaces of reinforcement learning libraries, one module each.

Nothing is imported here, because the libraries are the extra ``train``: import
``mjstack.adapters.gymnasium`` or ``mjstack.adapters.rsl_rl``.
"""

from __future__ import annotations

from mjstack.errors import MjstackError


class MissingExtra(MjstackError):
    """A library that belongs to an extra and cannot be imported."""

    exit_code = 2

    def __init__(self, module: str, library: str, reason: ImportError) -> None:
        """Builds the message.

        Args:
            module: The adapter.
            library: What it needs, as pip calls it.
            reason: What the import said; it may be another library, which this one needs.
        """
        said = " ".join(str(reason).split())
        super().__init__(
            f"{module} needs {library}, which cannot be imported ({said}). Run: pip install"
            " 'mjstack[train]'."
        )
