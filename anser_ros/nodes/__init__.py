"""Holds the ROS 2 nodes: the only place that knows rclpy and the message packages.

``runtime`` holds what every node runs in, and ``streams`` what several nodes receive or send.
"""

import gc
import os
import signal
import sys

from anser_ros.parallel import ONE_THREAD

# Before numpy is imported: the threads of BLAS wait busily for each other between small matrices,
# which takes the second core from the other nodes, and a quarter of the windows with it.
for variable in ONE_THREAD:
    os.environ.setdefault(variable, '1')

# Python names a program so while it looks for it, before the program itself imports anything: a
# Ctrl-C in these seconds ends it as one later does, and not with the imports' traceback.
if sys.argv[0] == '-m':
    signal.signal(signal.SIGINT, lambda *_: os._exit(0))
    # Imports leave no garbage: to look for it makes a start an eighth longer. See `process`.
    gc.disable()
