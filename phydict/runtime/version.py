"""Which version this is."""

VERSION = "0.6.1"
