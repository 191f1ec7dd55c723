"""Trained rivals: published networks that map X-rays to a CT without a projector in the loop, re-implemented."""

from phydict.rivals.discriminator import PatchDiscriminator
from phydict.rivals.files import NETWORKS, build_rival, load_rival
from phydict.rivals.lifted import LiftedNetwork
from phydict.rivals.method import RivalAnswer, TrainedRival
from phydict.rivals.network import RivalNetwork
from phydict.rivals.rival import Rival
from phydict.rivals.x2ct import X2CTNetwork
from phydict.rivals.xray2ctpa import XrayToCTPANetwork

__all__ = ["NETWORKS", "LiftedNetwork", "PatchDiscriminator", "Rival", "RivalAnswer", "RivalNetwork", "TrainedRival",
           "X2CTNetwork", "XrayToCTPANetwork", "build_rival", "load_rival"]
