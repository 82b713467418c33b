// SPDX-License-Identifier: BSD-3-Clause
// Prints the poses of a robot: roundel-poses tcp/localhost:7447 demo rover
#include <chrono>
#include <cmath>
#include <cstdio>
#include <exception>
#include <string>
#include <thread>
#include <zenoh.hxx>

#include "robot_pose.hpp"

void print(const RobotPose& pose) {
    const auto& [x, y, z] = pose.position;
    std::printf("%lld %s %.6f %.6f %.6f, sigma of x %.6f m\n", static_cast<long long>(pose.t_ns),
                pose.state.c_str(), x, y, z, std::sqrt(pose.covariance[3 * 12 + 3]));
}

int main(int argc, char** argv) {
    if (argc != 4) {
        std::fprintf(stderr, "usage: roundel-poses ENDPOINT ARENA ROBOT\n");
        return 2;
    }
    try {
        auto config = zenoh::Config::create_default();
        config.insert_json5("mode", "'client'");
        config.insert_json5("connect/endpoints", "['" + std::string(argv[1]) + "']");
        config.insert_json5("connect/timeout_ms", "-1"); // wait for the server
        auto session = zenoh::Session::open(std::move(config));
        const auto key = std::string(argv[2]) + "/robot/" + argv[3] + "/pose";
        auto subscriber = session.declare_subscriber(
            zenoh::KeyExpr(key),
            [](const zenoh::Sample& sample) { // on Zenoh's thread: it must be fast
                try {
                    print(decode_robot_pose(sample.get_payload().as_vector()));
                } catch (const std::exception& error) {
                    std::fprintf(stderr, "skipped a message: %s\n", error.what());
                }
            },
            zenoh::closures::none);
        while (true) std::this_thread::sleep_for(std::chrono::hours(1));
    } catch (const std::exception& error) {
        std::fprintf(stderr, "error: %s\n", error.what());
        return 1;
    }
}
