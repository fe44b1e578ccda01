"""The configuration files of mjstack."""
