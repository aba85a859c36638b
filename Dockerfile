# ROS from apt, every other Python package from requirements.lock. Build: docker build -t buildloc .
# Nodes: docker run --rm --network host buildloc ros2 launch buildloc buildloc.launch.py
FROM ros:jazzy-ros-base-noble

SHELL ["/bin/bash", "-o", "pipefail", "-c"]

# apt keeps no old ROS versions: a pinned one would stop building within weeks.
# hadolint ignore=DL3008
RUN apt-get update \
 && apt-get install --yes --no-install-recommends \
      python3-venv \
      ros-jazzy-common-interfaces \
      ros-jazzy-launch-ros \
      ros-jazzy-rclpy \
      ros-jazzy-rmw-fastrtps-cpp \
 && rm -rf /var/lib/apt/lists/*

# The virtual environment sees apt's rclpy and takes the rest from the lock file, hashes checked.
WORKDIR /buildloc
COPY requirements.lock ./
RUN python3 -m venv --system-site-packages /opt/buildloc \
 && awk '/^[^ #]/ { ros = /^ros-/ } !ros' requirements.lock > pip.lock \
 && /opt/buildloc/bin/pip install --no-cache-dir --require-hashes --requirement pip.lock

# colcon runs in the virtual environment, so that every node starts with its Python.
COPY src src
RUN source /opt/ros/jazzy/setup.bash \
 && /opt/buildloc/bin/python -m colcon build --base-paths src --merge-install

# What is compiled is kept there: the user must own it, as a volume too.
RUN install -d -o 1000 -g 1000 /home/ubuntu/.cache

ENV PATH=/opt/buildloc/bin:/buildloc/install/lib/buildloc:$PATH
USER 1000
WORKDIR /home/ubuntu
ENTRYPOINT ["/bin/bash", "-c", "source /opt/ros/jazzy/setup.bash && source /buildloc/install/setup.bash && exec \"$@\"", "buildloc"]
CMD ["buildloc", "--help"]
