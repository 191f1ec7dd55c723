"""Train a prior: python train.py fit -c configs/prior/phantom.yaml"""

from phydict.cli.train import main

if __name__ == "__main__":
    main()
