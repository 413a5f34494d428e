//! A session of the chain of decisions is logged, read and replayed, also from damaged files.

use super::line::Line;
use super::loop_log::{About, LoopLog};
use super::place::{FILE, OLDER_FILE, files_of};
use super::reader::LogReader;
use super::writer::{LogWriter, MAX_WAITING};
use super::{IncidentKind, Incidents, Replayed, incidents, replay};
use crate::steering::test_arm::{PANDA, START, panda};
use drivers::motion::{ArmState, Follower, brake_limits};
use kinematics::{Stamp, Transform};
use std::path::{Path, PathBuf};
use std::time::Duration;
use steering::{
    AnalyticScene, Command, Device, Intent, NearestPosture, Operator, Request, Robot, Steering,
    SteeringConfig,
};

const CYCLE: Duration = Duration::from_millis(5);
const ANA: Operator = Operator(1);
const BEN: Operator = Operator(2);

/// A chain of decisions, its arm, and its log.
struct Session {
    steering: Steering,
    follower: Follower,
    log: LoopLog,
    now: Stamp,
    sequence: u64,
}

impl Session {
    fn new(folder: &Path) -> Self {
        let (chain, body, limits) = panda();
        let robot = Robot {
            inverse: Box::new(NearestPosture::new(chain.clone())),
            body,
            chain,
            joints: &limits,
            free_posture: Some(&START),
        };
        let steering = Steering::new(SteeringConfig::default(), robot).expect("valid");
        let brake = brake_limits(&limits, 2.0);
        let about = About {
            urdf: PANDA.to_owned(),
            world_from_base: Transform::translation(1.0, 0.0, 0.0),
        };
        Self {
            follower: Follower::new(&limits, &brake, &START, CYCLE).expect("valid"),
            log: LoopLog::new(folder, about, &steering).expect("a thread"),
            steering,
            now: Stamp(7_000_000_000),
            sequence: 0,
        }
    }

    fn request(&mut self, request: Request) {
        let _ = self.steering.handle(self.now, &request);
    }

    fn command(&mut self, grip: Option<u64>, down_m: f64) {
        self.sequence += 1;
        self.request(Request::Command(Command {
            operator: ANA,
            device: Device(9),
            sequence: self.sequence,
            captured_at: self.now,
            received_at: self.now,
            grip,
            intent: Intent::Hand {
                base_from_hand: [0.0, 0.0, -down_m, 0.0, 0.0, 0.0, 1.0],
            },
        }));
    }

    /// One cycle. Everything around is always seen, except far away.
    fn cycle(&mut self) {
        self.now += CYCLE;
        let scene = AnalyticScene {
            solids: Vec::new(),
            seen_at: self.now,
            seen_radius_m: 3.0,
        };
        let arm = ArmState {
            reported_at: self.now,
            position: self.follower.setpoint().position.clone(),
            is_at_rest: self.follower.is_at_rest(),
            braked_motion: self.follower.braked_motion(),
            stopped: None,
        };
        let verdict = self.steering.cycle(self.now, &arm, &scene);
        self.log.take(self.now, &mut self.steering);
        self.follower
            .obey(self.now, &verdict.output)
            .expect("valid");
        self.follower.step(self.now).expect("it brakes");
    }

    fn wait(&mut self, n_cycles: usize) {
        for _ in 0..n_cycles {
            self.cycle();
        }
    }

    /// Takes control, moves down, is stopped by somebody else, and becomes silent.
    fn run(&mut self) {
        self.wait(100);
        self.request(Request::TakeLease(ANA));
        self.command(None, 0.0);
        self.wait(300);
        for step in 0..200_u32 {
            self.command(Some(1), 2e-4 * f64::from(step));
            self.wait(2);
        }
        self.request(Request::TakeLease(BEN));
        self.request(Request::Stop { by: Some(BEN) });
        self.command(Some(1), 1.0);
        self.wait(1300);
    }
}

/// A log of [`Session::run`].
fn logged() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("a folder");
    Session::new(folder.path()).run();
    let file = folder.path().join(FILE);
    (folder, file)
}

fn replayed(file: &Path) -> Replayed {
    replay(&[file.to_owned()]).expect("a log")
}

fn lines(file: &Path) -> Vec<Line> {
    let mut reader = LogReader::open(file).expect("a log");
    std::iter::from_fn(|| reader.next().expect("of this version")).collect()
}

#[test]
fn logged_session_is_replayed_bit_for_bit_and_idle_cycles_are_left_out() {
    let (folder, file) = logged();
    let result = replayed(&file);
    assert!(result.is_identical(), "{}", result.sentence());
    assert_eq!((result.missing, result.damage.as_deref()), (0, None));
    assert_eq!(result.targets, 400);
    // About 1600 cycles without effect took 8 s.
    assert!(
        (600..900).contains(&result.decisions),
        "{}",
        result.decisions
    );
    assert!(result.seconds > 9.9, "{}", result.seconds);
    let sentence = result.sentence();
    assert!(
        sentence.ends_with("all 400 targets are the same bit for bit"),
        "{sentence}"
    );
    assert!(matches!(lines(&file).last(), Some(Line::End(_))));
    assert_eq!(files_of(folder.path()).expect("it is there"), [file]);
    assert!(files_of(&folder.path().join("splat")).is_ok(), "of a model");
    assert!(files_of(&folder.path().join("other")).is_err());
    let nowhere = tempfile::tempdir().expect("a folder");
    let message = files_of(nowhere.path()).expect_err("none").to_string();
    assert!(message.contains("no steering log"), "{message}");
}

#[test]
fn session_without_requests_writes_no_file() {
    let folder = tempfile::tempdir().expect("a folder");
    Session::new(folder.path()).wait(500);
    assert!(!folder.path().join(FILE).exists());
}

#[test]
fn killed_program_leaves_all_complete_lines() {
    let (_folder, file) = logged();
    let all = lines(&file);
    let bytes = std::fs::read(&file).expect("it is there");
    for keep in [bytes.len() - 1, bytes.len() * 2 / 3, bytes.len() / 3] {
        std::fs::write(&file, &bytes[..keep]).expect("space");
        let read = lines(&file);
        assert_eq!(read, all[..read.len()], "{keep} bytes");
        let n_min = if keep > bytes.len() / 2 {
            all.len() / 4
        } else {
            1
        };
        assert!(read.len() >= n_min, "{} of {}", read.len(), all.len());
        let result = replayed(&file);
        assert!(result.is_identical(), "{}", result.sentence());
        assert_eq!(result.damage, None, "it is only incomplete");
    }
}

#[test]
fn changed_target_and_changed_byte_are_found() {
    let (folder, file) = logged();
    let bytes = std::fs::read(&file).expect("it is there");
    let n_all = replayed(&file).decisions;
    // Nearly everywhere in the file, and in the checksum at its end.
    for at in [500, bytes.len() / 2, bytes.len() * 3 / 4, bytes.len() - 6] {
        let mut damaged = bytes.clone();
        damaged[at] ^= 0x10;
        std::fs::write(&file, &damaged).expect("space");
        let is_found = match replay(std::slice::from_ref(&file)) {
            Ok(result) => {
                result.damage.is_some() || !result.is_identical() || result.decisions < n_all
            }
            Err(error) => !error.to_string().is_empty(),
        };
        assert!(is_found, "byte {at}");
    }

    // A log with one changed bit of a target, which is complete otherwise.
    std::fs::write(&file, &bytes).expect("space");
    let mut changed = lines(&file);
    let target = changed.iter_mut().rev().find_map(|line| match line {
        Line::Entry(entry) => match &mut **entry {
            steering::Entry::Cycle { arm, .. } => match &mut arm.as_mut()?.verdict.output {
                steering::Output::Follow(target) => Some(target),
                steering::Output::Brake => None,
            },
            steering::Entry::Request { .. } => None,
        },
        _ => None,
    });
    let q = &mut target.expect("a target").position[2];
    *q = f64::from_bits(q.to_bits() ^ 1);
    std::fs::remove_file(&file).expect("ours");
    let writer = LogWriter::start(folder.path()).expect("a thread");
    assert!(writer.send(changed));
    drop(writer);
    let result = replayed(&file);
    let first = result.difference.clone().expect("one bit differs");
    assert!((3.0..4.5).contains(&first.seconds), "{}", first.seconds);
    assert!(
        result.sentence().contains("the replay differs"),
        "{}",
        result.sentence()
    );
}

#[test]
fn foreign_and_hostile_files_are_refused_with_a_sentence() {
    use std::io::Write;
    let folder = tempfile::tempdir().expect("a folder");
    let gzip = |text: &[u8]| {
        let mut gz = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        gz.write_all(text).expect("memory");
        gz.finish().expect("memory")
    };
    let zeros = vec![0; 130 << 20];
    for (name, bytes) in [
        ("empty", Vec::new()),
        ("text", b"# keyframes".to_vec()),
        ("lines", gzip(b"{\"a\":1}\n")),
        ("expands", gzip(&zeros)),
        ("old", gzip(b"{\"end\":{\"at\":5}}\n")),
    ] {
        let file = folder.path().join(name);
        std::fs::write(&file, bytes).expect("space");
        let message = format!("{:#}", replay(&[file]).expect_err(name));
        assert!(
            message.contains("is not a steering log"),
            "{name}: {message}"
        );
    }
    let (_folder, file) = logged();
    let mut newer = lines(&file);
    if let Some(Line::Start(start)) = newer.first_mut() {
        start.version += 1;
    }
    let writer = LogWriter::start(folder.path()).expect("a thread");
    assert!(writer.send(newer));
    drop(writer);
    let message = replay(&[folder.path().join(FILE)])
        .expect_err("newer")
        .to_string();
    assert!(message.contains("format 2"), "{message}");
}

#[test]
fn full_file_becomes_the_older_part_and_both_are_replayed_alone() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut session = Session::new(folder.path());
    session
        .log
        .replace_writer(LogWriter::with_file_size(folder.path(), 1).expect("a thread"));
    session.run();
    // The writer asks for a new file when a member ends.
    let mut n_cycles = 0;
    while !folder.path().join(OLDER_FILE).exists() {
        session.request(Request::RenewLease(ANA));
        session.wait(1);
        n_cycles += 1;
        assert!(n_cycles < 200_000, "no new file");
    }
    drop(session);
    let files = files_of(folder.path()).expect("both");
    assert_eq!(files.len(), 2);
    for file in &files {
        let result = replayed(file);
        assert!(result.is_identical(), "{}", result.sentence());
    }
    let result = replay(&files).expect("a log");
    assert!(
        result.is_identical() && result.targets == 400,
        "{}",
        result.sentence()
    );
}

#[test]
fn lines_that_the_disk_cannot_take_are_counted_and_the_log_starts_again() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut session = Session::new(folder.path());
    let (writer, disk) = LogWriter::blocked(folder.path()).expect("a thread");
    session.log.replace_writer(writer);
    session.request(Request::TakeLease(ANA));
    for _ in 0..MAX_WAITING + 500 {
        session.request(Request::RenewLease(ANA));
        session.cycle();
    }
    drop(disk); // It continues.
    let began = std::time::Instant::now();
    while session.log.n_missing() > 0 {
        assert!(
            began.elapsed() < Duration::from_secs(300),
            "it does not continue"
        );
        session.request(Request::RenewLease(ANA));
        session.cycle();
        std::thread::sleep(Duration::from_millis(1));
    }
    session.run();
    drop(session);
    let result = replayed(&folder.path().join(FILE));
    assert!(result.is_identical(), "{}", result.sentence());
    assert!(result.missing >= 500 && result.targets == 400, "{result:?}");
}

#[test]
fn incidents_have_words_times_and_postures() {
    let (_folder, file) = logged();
    let Incidents {
        incidents: found,
        joint_names,
        world_from_base,
        seconds,
        track,
        ..
    } = incidents(&[file]).expect("a log");
    let texts: Vec<&str> = found.iter().map(|incident| &*incident.text).collect();
    for (ix, (kind, text)) in [
        (IncidentKind::Lease, "operator 1 took control"),
        (
            IncidentKind::Refused,
            "control was refused: operator 1 has control",
        ),
        (IncidentKind::Stop, "operator 2 stopped the arm"),
        (
            IncidentKind::Refused,
            "a command was refused: stopped by operator 2",
        ),
    ]
    .into_iter()
    .enumerate()
    {
        assert_eq!(found[ix].kind, kind, "{texts:?}");
        assert!(found[ix].text.starts_with(text), "{texts:?}");
    }
    assert_eq!(found.len(), 4, "{texts:?}");
    let stop = &found[2];
    assert_eq!((stop.operator, joint_names.len()), (Some(1), 7));
    assert!(
        (3.4..3.6).contains(&stop.seconds) && seconds > 9.0,
        "{stop:?}"
    );
    let target = stop.target.as_ref().expect("it was followed");
    assert!(
        target[3] != START[3] && stop.position[3] != START[3],
        "{stop:?}"
    );
    // The track shows how the arm was moved and came to rest.
    let around: Vec<_> = track
        .iter()
        .filter(|sample| (sample.seconds - stop.seconds).abs() < 1.0)
        .collect();
    // About 20 samples per second while the arm moves, and fewer while it rests.
    let n_before = around
        .iter()
        .filter(|sample| sample.seconds < stop.seconds)
        .count();
    assert!(
        n_before >= 15 && around.len() > n_before,
        "{n_before} of {}",
        around.len()
    );
    assert!(around[0].target.is_some(), "{around:?}");
    let last = around.last().expect("some");
    assert!(last.target.is_none() && last.position != around[0].position);
    assert!(track.iter().is_sorted_by(|a, b| a.seconds < b.seconds));
    assert_eq!(world_from_base[0], 1.0);
}
