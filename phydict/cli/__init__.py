"""The command lines of train.py and infer.py."""
