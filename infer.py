"""Reconstruct: python infer.py predict -c configs/reconstruct/phydict_fast.yaml --data.xrays <folder>"""

from phydict.cli.infer import main

if __name__ == "__main__":
    main()
