# Ubuntu 24.04 with ROS 2 Jazzy's own packages, and this package built by colcon.
#
#   docker build -t anser_ros .
#   docker run --rm -it --network host --device /dev/ttyACM0 anser_ros \
#       ros2 launch anser_ros anser.launch.py device:=/dev/ttyACM0
#
# The list of packages is that of package.xml: test/test_release.py compares.
FROM ros:jazzy-ros-base-noble

RUN apt-get update && apt-get install -y --no-install-recommends \
    python3-h5py \
    python3-matplotlib \
    python3-numba \
    python3-numpy \
    python3-pandas \
    python3-pip \
    python3-rich \
    python3-scipy \
    python3-serial \
    python3-yaml \
    ros-jazzy-builtin-interfaces \
    ros-jazzy-diagnostic-msgs \
    ros-jazzy-geometry-msgs \
    ros-jazzy-launch \
    ros-jazzy-launch-ros \
    ros-jazzy-rcl-interfaces \
    ros-jazzy-rclpy \
    ros-jazzy-rosgraph-msgs \
    ros-jazzy-sensor-msgs \
    ros-jazzy-std-msgs \
    ros-jazzy-std-srvs \
    ros-jazzy-tf2-msgs \
    ros-jazzy-visualization-msgs \
    && rm -rf /var/lib/apt/lists/*

# What has no package in Ubuntu; the lock keeps the rest of the system's Python as it is.
RUN python3 -m pip install --no-cache-dir --break-system-packages --no-deps \
    allantools mcap mcap-ros2-support zstandard lz4 click jinja2 markupsafe aiofiles aiohappyeyeballs aiohttp aiosignal annotated-doc annotated-types anyio attrs bidict fastapi frozenlist h11 httpcore httptools httpx ifaddr itsdangerous markdown2 multidict nicegui opentelemetry-api orjson propcache pydantic pydantic-core python-dotenv python-engineio python-multipart python-socketio simple-websocket starlette tinycss2 typing-inspection uvicorn uvloop watchfiles webencodings websockets wsproto yarl certifi idna pygments docutils typing-extensions

WORKDIR /workspace
COPY . src/anser_ros
RUN . /opt/ros/jazzy/setup.sh && colcon build --packages-select anser_ros

# As the user who runs the nodes: kernels are compiled once, not at the first start.
RUN . install/setup.sh && ros2 run anser_ros warm_up

RUN printf '#!/bin/sh\n. /workspace/install/setup.sh\nexec "$@"\n' > /entrypoint.sh \
    && chmod +x /entrypoint.sh
ENTRYPOINT ["/entrypoint.sh"]
CMD ["ros2", "run", "anser_ros", "doctor"]
