"""What every part needs of the machine: whole files, consoles, settings, precision, profiles."""
