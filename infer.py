"""Reconstruct: python infer.py predict --data.xrays <folder>"""

from phydict.cli.infer import main

if __name__ == "__main__":
    main()
