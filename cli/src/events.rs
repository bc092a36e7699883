//! TensorBoard event files: `raygrad train --tensorboard`.
//!
//! A file is a sequence of TensorFlow's TFRecords: length, checksum of the length, data, checksum of the data. The data
//! is an `Event` of `event.proto` in protocol buffer encoding.

use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

use crc::{CRC_32_ISCSI, Crc};
use raygrad::nerf::Result;

use super::journal::Journal;
use super::output::make_folder;

/// Prefix of file names. The seconds since 1970 follow.
const PREFIX: &str = "events.out.tfevents.";
/// CRC-32C.
const CHECKSUM: Crc<u32> = Crc::<u32>::new(&CRC_32_ISCSI);
/// `SessionLog.SessionStatus.START`.
const START: i64 = 1;
/// `Summary.Image.colorspace` of RGB images.
const RGB: i64 = 3;

/// The event file of one session of a run.
pub struct Events(Journal);

impl Events {
    /// Creates the folder and a new file in it for the steps from this one on. TensorBoard hides these steps of earlier
    /// files.
    pub fn create(folder: &Path, step: u64) -> Result<Self> {
        make_folder(folder)?;
        let time = now();
        // TensorBoard reads files in order of their names. This name is the last one, even if the clock went back.
        let after = latest(folder).map_or(0, |latest| latest.saturating_add(1));
        let path = folder.join(format!("{PREFIX}{:010}.raygrad", after.max(time as u64)));
        Journal::begin(&path, &[record(&version(time)), record(&start(time, step))].concat()).map(Events)
    }

    /// Adds named scalars of a step. TensorBoard groups names by the part before `/`.
    pub fn scalars(&mut self, step: u64, values: &[(String, f64)]) -> Result<()> {
        self.0.add(&record(&scalars(now(), step, values)))
    }

    /// Flushes all records to the disk.
    pub fn flush(&mut self) -> Result<()> {
        self.0.flush()
    }

    /// Adds a PNG file of this width and height.
    pub fn image(&mut self, step: u64, name: &str, size: [usize; 2], png: &[u8]) -> Result<()> {
        self.0.add(&record(&image(now(), step, name, size, png)))
    }
}

/// Seconds since 1970.
fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs_f64()
}

/// The seconds in the name of the last event file of a folder.
fn latest(folder: &Path) -> Option<u64> {
    let names = std::fs::read_dir(folder).ok()?.flatten().map(|entry| entry.file_name());
    let seconds = |name: &str| name.strip_prefix(PREFIX)?.split('.').next()?.parse().ok();
    names.filter_map(|name| seconds(name.to_str()?)).max()
}

/// The first event of a file: the format version and the writer.
fn version(time: f64) -> Vec<u8> {
    let writer = Message::default().bytes(1, b"raygrad");
    Message::default().double(1, time).bytes(3, b"brain.Event:2").bytes(10, &writer.0).0
}

/// Marks the start of a session at this step.
fn start(time: f64, step: u64) -> Vec<u8> {
    event(time, step).bytes(7, &Message::default().integer(1, START).0).0
}

fn scalars(time: f64, step: u64, values: &[(String, f64)]) -> Vec<u8> {
    let value = |(name, value): &(String, f64)| Message::default().bytes(1, name.as_bytes()).float(2, *value as f32);
    let summary = values.iter().fold(Message::default(), |summary, named| summary.bytes(1, &value(named).0));
    event(time, step).bytes(5, &summary.0).0
}

fn image(time: f64, step: u64, name: &str, [width, height]: [usize; 2], png: &[u8]) -> Vec<u8> {
    let image = Message::default().integer(1, height as i64).integer(2, width as i64).integer(3, RGB).bytes(4, png);
    let value = Message::default().bytes(1, name.as_bytes()).bytes(4, &image.0);
    event(time, step).bytes(5, &Message::default().bytes(1, &value.0).0).0
}

fn event(time: f64, step: u64) -> Message {
    Message::default().double(1, time).integer(2, step as i64)
}

/// A protocol buffer message with fields in the order of their numbers. As in other encoders, fields that are 0 are
/// omitted. [`float`](Self::float) is a `oneof` value, which is always written.
#[derive(Default)]
struct Message(Vec<u8>);

impl Message {
    fn varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }

    fn key(&mut self, field: u64, wire_type: u64) {
        self.varint(field << 3 | wire_type);
    }

    fn integer(mut self, field: u64, value: i64) -> Self {
        if value != 0 {
            self.key(field, 0);
            self.varint(value as u64);
        }
        self
    }

    fn double(mut self, field: u64, value: f64) -> Self {
        if value != 0.0 {
            self.key(field, 1);
            self.0.extend(value.to_le_bytes());
        }
        self
    }

    fn float(mut self, field: u64, value: f32) -> Self {
        self.key(field, 5);
        self.0.extend(value.to_le_bytes());
        self
    }

    fn bytes(mut self, field: u64, bytes: &[u8]) -> Self {
        self.key(field, 2);
        self.varint(bytes.len() as u64);
        self.0.extend(bytes);
        self
    }
}

fn record(bytes: &[u8]) -> Vec<u8> {
    let length = (bytes.len() as u64).to_le_bytes();
    let mut record = length.to_vec();
    record.extend(masked(&length).to_le_bytes());
    record.extend(bytes);
    record.extend(masked(bytes).to_le_bytes());
    record
}

/// The masked CRC of TFRecord, for data that itself contains CRCs.
fn masked(bytes: &[u8]) -> u32 {
    CHECKSUM.checksum(bytes).rotate_right(15).wrapping_add(0xa282_ead8)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Written by TensorBoard: see `tests/reference/events.py`.
    const REFERENCE: &[u8] = include_bytes!("../tests/reference/events.bin");

    #[test]
    fn events_equal_the_tensorboard_reference() {
        let named = |values: &[(&str, f64)]| -> Vec<(String, f64)> {
            values.iter().map(|(name, value)| ((*name).to_owned(), *value)).collect()
        };
        let png: Vec<u8> = (0..300_u32).map(|i| (7 * i % 256) as u8).collect();
        let losses = [("train/loss", 0.1), ("train/psnr", -3.5), ("train/skipped", 0.0)];
        let events = [
            version(1.7e9 + 0.25),
            start(1.7e9 + 0.5, 0),
            start(1.7e9 + 0.75, 41),
            scalars(1.7e9 + 1.0, 1, &named(&losses)),
            scalars(1.7e9 + 2.0, 300, &named(&[("größe", f64::NAN), ("x", f64::INFINITY), ("y", 1e300)])),
            scalars(0.0, 1 << 40, &named(&[("z", -0.0)])),
            image(1.7e9 + 3.0, 300, "preview/picture", [256, 96], &png),
        ];
        let written: Vec<u8> = events.iter().flat_map(|event| record(event)).collect();
        let differs = written.iter().zip(REFERENCE).position(|(a, b)| a != b);
        assert_eq!((differs, written.len()), (None, REFERENCE.len()));
    }

    #[test]
    fn varint_groups_have_seven_bits() {
        let full = [[0xff; 9].as_slice(), &[1]].concat();
        let cases: [(u64, &[u8]); 7] = [
            (0, &[0]),
            (127, &[0x7f]),
            (128, &[0x80, 1]),
            (150, &[0x96, 1]),
            (300, &[0xac, 2]),
            (0xff80, &[0x80, 0xff, 3]),
            (u64::MAX, &full),
        ];
        for (value, expected) in cases {
            let mut message = Message::default();
            message.varint(value);
            assert_eq!(message.0, expected, "{value}");
        }
    }

    #[test]
    fn create_again_gives_a_later_name() {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path().join("made");
        for number in 0..2 {
            Events::create(&folder, number).unwrap();
        }
        let names = || -> Vec<String> {
            let entries = std::fs::read_dir(&folder).unwrap();
            let mut names: Vec<_> = entries.map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
            names.sort();
            names
        };
        assert_eq!(names().len(), 2);
        std::fs::write(folder.join(format!("{PREFIX}9000000000.other.7")), b"").unwrap();
        std::fs::write(folder.join("events.out.tfevents.none"), b"").unwrap();
        let mut events = Events::create(&folder, 7).unwrap();
        let path = folder.join(format!("{PREFIX}9000000001.raygrad"));
        assert_eq!(names()[3], path.file_name().unwrap().to_str().unwrap());
        let length = || std::fs::metadata(&path).unwrap().len();
        let begun = length();
        events.scalars(8, &[("x".to_owned(), 1.0)]).unwrap();
        // Length, its checksum, time, step, summary of 10 bytes, and the checksum of the data.
        assert_eq!(length() - begun, 8 + 4 + 9 + 2 + 12 + 4);
    }
}
