"""Poses and gains of views, found together with the volume that they show, without a CT."""

from phydict.poses.found import FoundPoses
from phydict.poses.search import PoseSearch, find_poses

__all__ = ["FoundPoses", "PoseSearch", "find_poses"]
