//! Values on the command line: numbers, durations, sizes and colours.

use std::fmt::Display;
use std::ops::Bound::Included;
use std::ops::{RangeBounds, RangeInclusive};
use std::path::Path;
use std::str::FromStr;
use std::time::Duration;

use raygrad::nerf::Error;
use raygrad::nerf::glam::DVec3;
use serde_json::Value;

/// Parses an integer from 1 to `most`.
pub fn count(most: usize) -> impl Fn(&str) -> Result<usize, String> + Clone + Send + Sync + 'static {
    within(1..=most)
}

/// Parses an integer in a range with a lower bound.
pub fn within<N, R>(range: R) -> impl Fn(&str) -> Result<N, String> + Clone + Send + Sync + 'static
where
    N: FromStr + PartialOrd + Display + 'static,
    R: RangeBounds<N> + Clone + Send + Sync + 'static,
{
    move |text| {
        text.parse().ok().filter(|number| range.contains(number)).ok_or_else(|| {
            match (range.start_bound(), range.end_bound()) {
                (Included(least), Included(most)) => format!("write a whole number from {least} to {most}"),
                (Included(least), _) => format!("write a whole number of at least {least}"),
                _ => "write a whole number".to_owned(),
            }
        })
    }
}

/// Parses a word of a list, such as a preset. The error is the list alone, since clap's own text has flag and value.
pub fn word<T: FromStr<Err = Error>>(text: &str) -> Result<T, String> {
    text.parse().map_err(|error: Error| match error {
        Error::Setting { what, .. } => what.split_once("; ").map_or(what.clone(), |(_, remedy)| remedy.to_owned()),
        error => error.to_string(),
    })
}

/// Parses a duration such as `90s`, `10m` or `1.5h`.
pub fn duration(text: &str) -> Result<Duration, String> {
    let usage = || "write a number and a unit: 90s, 10m or 1.5h".to_owned();
    let (number, unit) = text.char_indices().next_back().map(|(last, _)| text.split_at(last)).ok_or_else(usage)?;
    let seconds = match unit {
        "s" => 1.0,
        "m" => 60.0,
        "h" => 3600.0,
        _ => return Err(usage()),
    };
    let number: f64 = number.parse().map_err(|_| usage())?;
    match Duration::try_from_secs_f64(number * seconds) {
        Ok(duration) if !duration.is_zero() => Ok(duration),
        _ => Err("must be more than 0 and finite".to_owned()),
    }
}

/// Largest side of an image in pixels.
pub const LARGEST: usize = 16384;

/// Frames per second that video formats support.
pub const FPS: RangeInclusive<f64> = 0.01..=240.0;

/// Parses frames per second.
pub fn fps(text: &str) -> Result<f64, String> {
    let usage = || format!("write a number from {} to {}", FPS.start(), FPS.end());
    text.parse().ok().filter(|fps| FPS.contains(fps)).ok_or_else(usage)
}

/// Parses a width and a height, such as `400x300`.
pub fn size(text: &str) -> Result<[usize; 2], String> {
    let usage = || format!("write WIDTHxHEIGHT such as 400x300, each from 1 to {LARGEST}");
    let (width, height) = text.split_once('x').ok_or_else(usage)?;
    let side = |text: &str| text.parse().ok().filter(|side| (1..=LARGEST).contains(side)).ok_or_else(usage);
    Ok([side(width)?, side(height)?])
}

/// Parses an aspect ratio, such as `16:9`: width over height.
pub fn aspect(text: &str) -> Result<f64, String> {
    let usage = || "write WIDTH:HEIGHT such as 16:9, from 1:20 to 20:1".to_owned();
    let (width, height) = text.split_once(':').ok_or_else(usage)?;
    let side = |text: &str| text.parse::<f64>().ok().filter(|side| *side > 0.0 && side.is_finite()).ok_or_else(usage);
    Some(side(width)? / side(height)?).filter(|aspect| (0.05..=20.0).contains(aspect)).ok_or_else(usage)
}

/// Parses a colour: `white`, `black`, or red, green and blue from 0 to 255, such as `255,200,0`. The result is in 0 to
/// 1.
pub fn color(text: &str) -> Result<[f32; 3], String> {
    let usage = || "write white, black or R,G,B such as 255,200,0, each from 0 to 255".to_owned();
    match text {
        "white" => return Ok([1.0; 3]),
        "black" => return Ok([0.0; 3]),
        _ => {}
    }
    let values = text.split(',').map(|value| Some(f32::from(value.trim().parse::<u8>().ok()?) / 255.0));
    let values: Vec<f32> = values.collect::<Option<_>>().ok_or_else(usage)?;
    values.try_into().map_err(|_| usage())
}

/// Parses the lower and the upper corner of a box: `X0,Y0,Z0,X1,Y1,Z1`.
pub fn corners(text: &str) -> Result<[DVec3; 2], String> {
    let usage =
        |what: String| format!("{what}; write X0,Y0,Z0,X1,Y1,Z1 such as -1,-1,0,1,1,2: lower, then upper corner");
    let number = |word: &str| {
        let number = word.trim().parse().ok().filter(|x: &f64| x.is_finite());
        number.ok_or_else(|| usage(format!("`{word}` is not a finite number")))
    };
    let numbers: Vec<f64> = text.split(',').map(number).collect::<Result<_, _>>()?;
    let [low, high] = match <[f64; 6]>::try_from(numbers) {
        Ok([x0, y0, z0, x1, y1, z1]) => [DVec3::new(x0, y0, z0), DVec3::new(x1, y1, z1)],
        Err(numbers) => return Err(usage(format!("a box needs 6 numbers, not {}", numbers.len()))),
    };
    match (0..3).find(|axis| low[*axis] >= high[*axis]) {
        Some(axis) => Err(usage(format!("along {}, {} is not below {}", ["x", "y", "z"][axis], low[axis], high[axis]))),
        None => Ok([low, high]),
    }
}

/// Parses a finite number above 0.
pub fn above_zero(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|x: &f64| *x > 0.0 && x.is_finite()).ok_or_else(|| "write a number above 0".to_owned())
}

/// Parses a number between two others, exclusive.
pub fn between(least: f64, most: f64) -> impl Fn(&str) -> Result<f64, String> + Clone + Send + Sync + 'static {
    move |text| {
        let inside = |x: &f64| least < *x && *x < most;
        text.parse().ok().filter(inside).ok_or_else(|| format!("write a number between {least} and {most}"))
    }
}

/// Parses `NAME=VALUE`. The value is JSON, or else a plain word.
pub fn setting(text: &str) -> Result<(String, Value), String> {
    let (name, value) = text.split_once('=').ok_or("write NAME=VALUE")?;
    let value = serde_json::from_str(value).unwrap_or_else(|_| Value::String(value.to_owned()));
    Ok((name.to_owned(), value))
}

/// Parses `NAME=WEIGHT`. The weight is 0 or more.
pub fn weight(text: &str) -> Result<(String, f64), String> {
    let usage = || "write NAME=WEIGHT such as entropy=0.001".to_owned();
    let (name, weight) = text.split_once('=').ok_or_else(usage)?;
    let weight = weight.parse().ok().filter(|weight: &f64| weight.is_finite() && *weight >= 0.0).ok_or_else(usage)?;
    Ok((name.to_owned(), weight))
}

/// Largest text file in bytes. Larger ones are of another kind.
const LONGEST: u64 = 1 << 28;

/// Reads a text file that should be `kind`, such as `an eval result`.
///
/// # Errors
///
/// Fails if it cannot be read, is not a regular file, or has more than 256 MiB.
pub fn read_text(path: &Path, kind: &str) -> raygrad::nerf::Result<String> {
    let bad = |what: String| Error::file(path, what);
    let unread = |e: std::io::Error| bad(format!("cannot be read: {e}"));
    let about = std::fs::metadata(path).map_err(unread)?;
    if about.len() > LONGEST {
        let [own, most] = [about.len(), LONGEST].map(|bytes| bytes >> 20);
        return Err(bad(format!("not {kind} ({own} MiB; the limit is {most} MiB)")));
    }
    // Devices and pipes may have no end.
    if !about.is_file() {
        return Err(bad(format!("not {kind}: it is not a regular file")));
    }
    let text = std::fs::read_to_string(path).map_err(unread)?;
    // Editors of Windows write a byte-order mark.
    Ok(text.strip_prefix('\u{feff}').map(str::to_owned).unwrap_or(text))
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad::nerf::dataset::{SceneType, Split};
    use raygrad::nerf::model::RefinedParam;
    use raygrad::nerf::space::occupancy::Skip;
    use raygrad::nerf::{Background, Preset};

    #[test]
    fn count_and_within_parse_or_refuse() {
        let keep = within(2..=16384usize);
        assert_eq!((keep("2"), keep("16384")), (Ok(2), Ok(16384)));
        for bad in ["", "1", "16385", "-2", "2.5", "1e3", "99999999999999999999"] {
            assert_eq!(keep(bad), Err("write a whole number from 2 to 16384".to_owned()), "{bad}");
        }
        let steps = within(1u64..);
        assert_eq!(steps("18446744073709551615"), Ok(u64::MAX));
        assert_eq!(steps("0"), Err("write a whole number of at least 1".to_owned()));
        assert_eq!((count(3)("3"), count(3)("0").is_err(), count(3)("4").is_err()), (Ok(3), true, true));
    }

    #[test]
    fn word_lists_the_words_in_its_error() {
        assert_eq!(word::<Preset>("voxel"), Ok(Preset::Voxel));
        assert_eq!(word::<Preset>("nerfacto"), Err("use classic, small, instant or voxel".to_owned()));
        assert_eq!(word::<RefinedParam>("pose"), Err("use poses, focal, lens, exposure or vignetting".to_owned()));
        for message in [
            word::<Skip>("none").unwrap_err(),
            word::<SceneType>("open").unwrap_err(),
            word::<Split>("all").unwrap_err(),
            word::<Background>("grey").unwrap_err(),
        ] {
            assert!(message.starts_with("use ") && message.contains(" or "), "{message}");
        }
    }

    #[test]
    fn duration_parses_or_refuses() {
        assert_eq!(duration("90s"), Ok(Duration::from_secs(90)));
        assert_eq!(duration("1.5m"), Ok(Duration::from_secs(90)));
        assert_eq!(duration("1h"), Ok(Duration::from_secs(3600)));
        for bad in ["", "s", "10", "m10", "10 d", "1e999h", "NaNs", "-1s", "0s", "5µ"] {
            assert!(duration(bad).is_err(), "{bad}");
        }
    }

    #[cfg(unix)]
    #[test]
    fn read_text_refuses_devices_and_large_files() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("path.json");
        std::fs::write(&file, "{}").unwrap();
        assert_eq!(read_text(&file, "a camera path").unwrap(), "{}");
        std::fs::write(&file, "\u{feff}{}").unwrap();
        assert_eq!(read_text(&file, "a camera path").unwrap(), "{}", "without a byte-order mark");
        std::fs::write(&file, [0xff]).unwrap();
        assert!(read_text(&file, "a camera path").unwrap_err().to_string().contains("path.json: cannot be read"));
        std::fs::File::create(&file).unwrap().set_len((1 << 28) + 1).unwrap();
        let expected = format!("{}: not a camera path (256 MiB; the limit is 256 MiB)", file.display());
        assert_eq!(read_text(&file, "a camera path").unwrap_err().to_string(), expected);
        for endless in ["/dev/zero", "/dev"] {
            let expected = format!("{endless}: not a camera path: it is not a regular file");
            assert_eq!(read_text(Path::new(endless), "a camera path").unwrap_err().to_string(), expected);
        }
    }

    #[test]
    fn size_parses_or_refuses() {
        assert_eq!(size("400x300"), Ok([400, 300]));
        for bad in ["", "x", "400", "0x0", "400x0", "-1x5", "4x3x2", "16385x1", "99999999999999999999x1"] {
            assert!(size(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn corners_parse_or_say_what_is_wrong() {
        let expected = [DVec3::new(-1.0, 0.5, 2e3), DVec3::new(0.0, 1.0, 3e3)];
        assert_eq!(corners("-1,.5,2e3, 0,1,3e3"), Ok(expected));
        for (bad, what) in [
            ("", "`` is not a finite number"),
            ("1,2,3,4,5,x", "`x` is not a finite number"),
            ("1,2,3,4,5,inf", "`inf` is not a finite number"),
            ("NaN,2,3,4,5,6", "`NaN` is not a finite number"),
            ("1,2,3,4,5", "a box needs 6 numbers, not 5"),
            ("1,2,3,4,5,6,7", "a box needs 6 numbers, not 7"),
            ("0,0,0,1,1,0", "along z, 0 is not below 0"),
            ("0,2,0,1,1,1", "along y, 2 is not below 1"),
        ] {
            let said = corners(bad).unwrap_err();
            assert!(said.starts_with(what) && said.contains("write X0,Y0,Z0,X1,Y1,Z1"), "{bad}: {said}");
        }
    }

    #[test]
    fn aspect_color_and_between_parse_or_refuse() {
        assert_eq!((aspect("16:10"), aspect("1:2.5")), (Ok(1.6), Ok(0.4)));
        for bad in ["", "16", "16:0", ":", "-1:2", "NaN:1", "1:inf", "21:1", "1:2:3"] {
            assert!(aspect(bad).is_err(), "{bad}");
        }
        assert_eq!(
            (color("white"), color("black"), color("255, 51,0")),
            (Ok([1.0; 3]), Ok([0.0; 3]), Ok([1.0, 0.2, 0.0]))
        );
        for bad in ["", "grey", "1,2", "1,2,3,4", "256,0,0", "-1,0,0", "0.5,0,0"] {
            assert!(color(bad).is_err(), "{bad}");
        }
        assert_eq!((above_zero("0.5"), above_zero("0").is_err(), above_zero("NaN").is_err()), (Ok(0.5), true, true));
        let angle = between(0.0, 180.0);
        assert_eq!(
            (angle("60"), angle("0").is_err(), angle("180").is_err(), angle("NaN").is_err()),
            (Ok(60.0), true, true, true)
        );
    }
}
