//! Text of files in the encodings that programs write.

/// Decodes UTF-8 and UTF-16, with or without a byte-order mark. Invalid parts become U+FFFD.
pub(super) fn decoded(bytes: &[u8]) -> String {
    let wide = |bytes: &[u8], unit: fn([u8; 2]) -> u16| {
        let units: Vec<u16> = bytes.chunks_exact(2).map(|pair| unit([pair[0], pair[1]])).collect();
        String::from_utf16_lossy(&units)
    };
    match bytes {
        [0xff, 0xfe, rest @ ..] => wide(rest, u16::from_le_bytes),
        [0xfe, 0xff, rest @ ..] => wide(rest, u16::from_be_bytes),
        [0xef, 0xbb, 0xbf, rest @ ..] => String::from_utf8_lossy(rest).into_owned(),
        // Files start with an ASCII character.
        [1..=255, 0, 1..=255, 0, ..] => wide(bytes, u16::from_le_bytes),
        [0, 1..=255, 0, 1..=255, ..] => wide(bytes, u16::from_be_bytes),
        _ => String::from_utf8_lossy(bytes).into_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_encodings_give_the_same_text() {
        let text = "{\"\u{e9}\": 1}\r\n";
        let wide = |bytes: fn(u16) -> [u8; 2]| text.encode_utf16().flat_map(bytes).collect::<Vec<u8>>();
        let [little, big, narrow] = [wide(u16::to_le_bytes), wide(u16::to_be_bytes), text.as_bytes().to_vec()];
        for (mark, bytes) in [
            (&[][..], &narrow),
            (&[0xef, 0xbb, 0xbf], &narrow),
            (&[], &little),
            (&[0xff, 0xfe], &little),
            (&[], &big),
            (&[0xfe, 0xff], &big),
        ] {
            assert_eq!(decoded(&[mark, bytes].concat()), text, "{mark:?}");
        }
        assert_eq!(decoded(b"caf\xe9.jpg"), "caf\u{fffd}.jpg", "Latin-1");
        assert_eq!(decoded(b""), "");
    }
}
