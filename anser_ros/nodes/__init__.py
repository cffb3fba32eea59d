"""Holds the ROS 2 nodes: the only place that knows rclpy and the message packages.

Each file here is a program. Its parts are in the room NODE_parts; ``runtime`` holds what every
node runs in, and ``streams`` what several nodes receive or send.
"""
