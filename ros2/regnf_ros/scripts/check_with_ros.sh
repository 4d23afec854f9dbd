#!/usr/bin/env bash
# Where ROS 2 is installed: builds the package, and asks the built node what it subscribes to and publishes.
#   source /opt/ros/DISTRIBUTION/setup.bash && ros2/regnf_ros/scripts/check_with_ros.sh
set -eo pipefail
package=$(cd "$(dirname "$0")/.." && pwd)
workspace=$(mktemp -d)
trap 'kill $node 2>/dev/null; rm -rf "$workspace"' EXIT
mkdir "$workspace/src" && cp -r "$package" "$workspace/src/"
cd "$workspace"
colcon build --packages-select regnf_ros
source install/setup.bash
for message in sensor_msgs/msg/CameraInfo vision_msgs/msg/Detection2DArray vision_msgs/msg/Detection3DArray \
    geometry_msgs/msg/PoseWithCovarianceStamped; do
    ros2 interface show "$message" >/dev/null
done
ros2 run regnf_ros register_objects --ros-args -p scene:=none -p "objects:=dining table=$(printf '0%.0s' {1..64})" \
    -p up_axis:=y -p scale_tolerance:=0.03 &
node=$!
for _ in $(seq 30); do
    if info=$(ros2 node info /regnf 2>/dev/null) && grep -q Detection2DArray <<<"$info"; then
        echo "$info"
        exit 0
    fi
    sleep 1
done
echo "the node did not come up" >&2
exit 1
