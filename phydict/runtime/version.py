"""Which version this is."""

VERSION = "0.7.18"
