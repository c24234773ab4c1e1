"""Reading bags without ROS: recordings <-> numpy, and a report of everything that is wrong with them."""

from agv_analysis.bags.bag import Bag, Topic, read_bag
from agv_analysis.bags.bag_errors import BagError

__all__ = ["Bag", "BagError", "Topic", "read_bag"]
