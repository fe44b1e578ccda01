"""How worlds start: placement, domain randomization, files of starts."""
