"""Train a prior: python train.py fit -c configs/prior/phantom.yaml"""

import sys

try:
    from phydict.cli.train import main
except KeyboardInterrupt:  # the imports take seconds
    sys.exit(130)

if __name__ == "__main__":
    main()
