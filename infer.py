"""Reconstruct: python infer.py predict --data.xrays <folder>"""

import sys

try:
    from phydict.cli.infer import main
except KeyboardInterrupt:  # the imports take seconds
    sys.exit(130)

if __name__ == "__main__":
    main()
