//! Binary Netpbm files as Kinect recordings have them: P6 of 8 bits and P5 of 16 bits.

/// Longest side read, pixels.
const SIDE_MAX: usize = 4096;

/// Pixels of one file.
#[derive(Debug, PartialEq)]
pub(super) struct Netpbm<'a> {
    pub width: usize,
    pub height: usize,
    /// As they lie in the file, row by row.
    pub bytes: &'a [u8],
}

/// Splits a file `MAGIC WIDTH HEIGHT MAX` and its pixels of `pixel_len` bytes; comments may stand
/// between the words. `max` is the only greatest value that is understood.
pub(super) fn parse<'a>(
    file: &'a [u8],
    magic: &str,
    max: usize,
    pixel_len: usize,
) -> Result<Netpbm<'a>, String> {
    let mut rest = file;
    let found = word(&mut rest);
    if found != magic.as_bytes() {
        let found = String::from_utf8_lossy(&found[..found.len().min(8)]);
        return Err(format!("starts with {found:?}, wanted {magic}"));
    }
    let mut number = |name: &str| {
        let text = word(&mut rest);
        let number = std::str::from_utf8(text)
            .ok()
            .and_then(|t| t.parse::<usize>().ok());
        number.ok_or_else(|| format!("{name} is no number"))
    };
    let (width, height) = (number("width")?, number("height")?);
    let found_max = number("greatest value")?;
    if !(1..=SIDE_MAX).contains(&width) || !(1..=SIDE_MAX).contains(&height) {
        return Err(format!(
            "is {width}x{height} pixels, sides must lie in 1..={SIDE_MAX}"
        ));
    }
    if found_max != max {
        return Err(format!("greatest value is {found_max}, wanted {max}"));
    }
    // One white-space character ends the header.
    let bytes = rest.get(1..).unwrap_or_default();
    let wanted = width * height * pixel_len;
    match bytes.len() == wanted {
        true => Ok(Netpbm {
            width,
            height,
            bytes,
        }),
        false => Err(format!(
            "has {} bytes of pixels, wanted {wanted}",
            bytes.len()
        )),
    }
}

/// Takes the next word, skipping white space and comments before it.
fn word<'a>(rest: &mut &'a [u8]) -> &'a [u8] {
    loop {
        let blank = rest
            .iter()
            .take_while(|byte| byte.is_ascii_whitespace())
            .count();
        *rest = &rest[blank..];
        if rest.first() != Some(&b'#') {
            break;
        }
        let comment = rest.iter().take_while(|byte| **byte != b'\n').count();
        *rest = &rest[comment..];
    }
    let len = rest
        .iter()
        .take_while(|byte| !byte.is_ascii_whitespace())
        .count();
    let (word, after) = rest.split_at(len);
    *rest = after;
    word
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn headers_are_read_and_faults_are_named() {
        let file = b"P5 # Kinect\n2 1\n65535\n\x01\x02\n\x04";
        let found = parse(file, "P5", 65535, 2).expect("a map");
        assert_eq!(
            (found.width, found.height, found.bytes),
            (2, 1, &b"\x01\x02\n\x04"[..])
        );
        for (file, fault) in [
            (&b"P6 2 1 255 abc"[..], "starts with \"P6\", wanted P5"),
            (b"P5 2", "height is no number"),
            (
                b"P5 2 0 65535\n",
                "is 2x0 pixels, sides must lie in 1..=4096",
            ),
            (b"P5 2 1 255\nabcd", "greatest value is 255, wanted 65535"),
            (b"P5 2 1 65535\nabc", "has 3 bytes of pixels, wanted 4"),
            (b"", "starts with \"\", wanted P5"),
        ] {
            assert_eq!(parse(file, "P5", 65535, 2), Err(fault.to_owned()));
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(128))]

        #[test]
        fn no_bytes_panic(head in "P5[ #\n0-9]{0,20}", tail in prop::collection::vec(any::<u8>(), 0..50)) {
            let mut file = head.into_bytes();
            file.extend(tail);
            if let Ok(found) = parse(&file, "P5", 65535, 2) {
                prop_assert_eq!(found.bytes.len(), 2 * found.width * found.height);
            }
        }
    }
}
