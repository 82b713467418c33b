// SPDX-License-Identifier: BSD-3-Clause
// A `RobotPose` as docs/messages.md defines it, decoded by nlohmann/json, which also reads MessagePack.
#pragma once

#include <array>
#include <cstdint>
#include <cstring>
#include <nlohmann/json.hpp>
#include <stdexcept>
#include <string>
#include <vector>

struct RobotPose {
    std::string robot;
    std::int64_t t_ns;                     // middle of the exposure, the server's Unix time
    std::string state;                     // tracked, coasting or lost
    std::array<double, 3> position;        // world, metres
    std::array<double, 4> quaternion_wxyz; // body to world
    std::array<double, 3> velocity;        // world, m/s
    std::array<float, 144> covariance;     // (12, 12): rotation, position, angular velocity, velocity
};

// Throws std::exception if the bytes are no RobotPose of version 1.
inline RobotPose decode_robot_pose(const std::vector<std::uint8_t>& data) {
    const auto fields = nlohmann::json::from_msgpack(data);
    if (fields.at("version").get<int>() != 1) throw std::runtime_error("a pose of another version");
    RobotPose pose;
    fields.at("robot").get_to(pose.robot);
    fields.at("t_ns").get_to(pose.t_ns);
    fields.at("state").get_to(pose.state);
    fields.at("position").get_to(pose.position);
    fields.at("quaternion_wxyz").get_to(pose.quaternion_wxyz);
    fields.at("velocity").get_to(pose.velocity);
    const auto& covariance = fields.at("covariance").get_binary(); // little-endian, as this machine
    if (covariance.size() != sizeof pose.covariance) throw std::runtime_error("a covariance of another size");
    std::memcpy(pose.covariance.data(), covariance.data(), covariance.size());
    return pose;
}
