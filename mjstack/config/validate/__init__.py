"""Checks values that types cannot: ranges, lengths, names, and how they fit together."""

from mjstack.config.validate.gate import PARITY_FIELDS
from mjstack.config.validate.root import validate
from mjstack.config.validate.term import places_objects, reads_starts_file

__all__ = ["PARITY_FIELDS", "places_objects", "reads_starts_file", "validate"]
