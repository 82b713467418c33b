// SPDX-License-Identifier: BSD-3-Clause
//! Prints the poses of a robot: `cargo run -- tcp/localhost:7447 demo rover [COUNT]`.
//!
//! docs/messages.md defines `RobotPose`. Times are the middle of the exposure in the server's Unix time.

use serde::Deserialize;
use std::{env, error::Error, process::ExitCode};
use zenoh::{Config, Wait};

const VERSION: u32 = 1;

/// What this program needs of a `RobotPose`; other fields are skipped.
#[derive(Deserialize)]
struct RobotPose {
    version: u32,
    t_ns: i64,
    state: String,             // tracked, coasting or lost
    position: [f64; 3],        // world, metres
    quaternion_wxyz: [f64; 4], // body to world
    #[serde(with = "serde_bytes")]
    covariance: Vec<u8>, // (12, 12) little-endian floats: rotation, position, angular velocity, velocity
}

impl RobotPose {
    fn decode(data: &[u8]) -> Result<Self, Box<dyn Error>> {
        let pose: RobotPose = rmp_serde::from_slice(data)?;
        if pose.version != VERSION || pose.covariance.len() != 12 * 12 * 4 {
            return Err(format!("version {} or a covariance of another size", pose.version).into());
        }
        Ok(pose)
    }

    /// Standard deviations of the position, metres.
    fn sigmas(&self) -> [f32; 3] {
        [3, 4, 5].map(|k| {
            let at = 4 * (12 * k + k);
            let bytes = self.covariance[at..at + 4].try_into().expect("four bytes");
            f32::from_le_bytes(bytes).sqrt()
        })
    }
}

fn run(endpoint: &str, key: &str, count: usize) -> Result<(), Box<dyn Error + Send + Sync>> {
    let mut config = Config::default();
    config.insert_json5("mode", "'client'")?;
    config.insert_json5("connect/endpoints", &format!("['{endpoint}']"))?;
    config.insert_json5("connect/timeout_ms", "-1")?; // wait for the server
    let session = zenoh::open(config).wait()?;
    let (newest, poses) = std::sync::mpsc::sync_channel(64);
    let _subscriber = session
        .declare_subscriber(key)
        .callback(move |sample| {
            let _ = newest.try_send(sample.payload().to_bytes().into_owned()); // a full queue loses poses
        })
        .wait()?;
    let mut printed = 0;
    for data in poses {
        match RobotPose::decode(&data) {
            Ok(pose) => {
                let RobotPose { t_ns, state, position, quaternion_wxyz, .. } = &pose;
                println!("{t_ns} {state} {position:?} {quaternion_wxyz:?} {:?}", pose.sigmas());
                printed += 1;
            }
            Err(error) => eprintln!("skipped a message: {error}"),
        }
        if printed == count {
            break;
        }
    }
    Ok(())
}

fn main() -> ExitCode {
    let words: Vec<String> = env::args().skip(1).collect();
    let [endpoint, arena, robot, count @ ..] = words.as_slice() else {
        eprintln!("usage: roundel-poses ENDPOINT ARENA ROBOT [COUNT]");
        return ExitCode::from(2);
    };
    let count = count.first().map_or(Ok(usize::MAX), |word| word.parse());
    let Ok(count) = count else {
        eprintln!("error: COUNT must be a number");
        return ExitCode::from(2);
    };
    match run(endpoint, &format!("{arena}/robot/{robot}/pose"), count) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}
