// SPDX-License-Identifier: BSD-3-Clause
// Reads one RobotPose from stdin by examples/cpp/robot_pose.hpp, and prints its numbers.
#include <cstdio>
#include <iterator>
#include <iostream>

#include "robot_pose.hpp"

int main() {
    const std::vector<std::uint8_t> data{std::istreambuf_iterator<char>(std::cin), {}};
    try {
        const auto pose = decode_robot_pose(data);
        std::printf("%s %lld %s", pose.robot.c_str(), static_cast<long long>(pose.t_ns), pose.state.c_str());
        for (double number : pose.position) std::printf(" %.17g", number);
        for (double number : pose.quaternion_wxyz) std::printf(" %.17g", number);
        for (double number : pose.velocity) std::printf(" %.17g", number);
        for (float number : pose.covariance) std::printf(" %.9g", number);
    } catch (const std::exception& error) {
        std::fprintf(stderr, "%s\n", error.what());
        return 1;
    }
}
