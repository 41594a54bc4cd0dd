//! Files and folders as the readers want them: bounded, sorted, and named when they are wrong.

use std::fs::{self, File};
use std::io::Read;
use std::path::{Path, PathBuf};

use super::error::ReadError;

/// Longest text file read, bytes: a drive's time stamps take 30 bytes a frame.
const TEXT_LEN_MAX: u64 = 8 << 20;

/// All of a file that is not longer than `max` bytes.
pub(super) fn bytes(path: &Path, max: u64) -> Result<Vec<u8>, ReadError> {
    let file = File::open(path).map_err(ReadError::in_file(path))?;
    let mut bytes = Vec::new();
    file.take(max.saturating_add(1))
        .read_to_end(&mut bytes)
        .map_err(ReadError::in_file(path))?;
    let len = bytes.len() as u64;
    if len > max {
        let path = path.into();
        return Err(ReadError::Long { path, len, max });
    }
    Ok(bytes)
}

/// A text file, in UTF-8.
pub(super) fn text(path: &Path) -> Result<String, ReadError> {
    String::from_utf8(bytes(path, TEXT_LEN_MAX)?).map_err(|error| {
        let at = error.utf8_error().valid_up_to();
        ReadError::content(path, format!("byte {at} is no UTF-8 text"))
    })
}

/// Names of what a folder holds, sorted; names that are no UTF-8 belong to no layout.
pub(super) fn names(folder: &Path) -> Result<Vec<String>, ReadError> {
    let mut names = Vec::new();
    for entry in fs::read_dir(folder).map_err(ReadError::in_file(folder))? {
        let entry = entry.map_err(ReadError::in_file(folder))?;
        names.extend(entry.file_name().into_string());
    }
    names.sort_unstable();
    Ok(names)
}

/// The first of several places that is a folder.
pub(super) fn first_folder(places: impl IntoIterator<Item = PathBuf>) -> Option<PathBuf> {
    places.into_iter().find(|place| place.is_dir())
}

/// Folders that hold a file with such a name: `root` and what lies up to `levels` below it, sorted.
/// What lies below a folder that is found is not looked at.
pub(super) fn folders_with(
    root: &Path,
    levels: usize,
    is_wanted: &dyn Fn(&str) -> bool,
) -> Result<Vec<PathBuf>, ReadError> {
    let names = names(root)?;
    if names.iter().any(|name| is_wanted(name)) {
        return Ok(vec![root.into()]);
    }
    let mut found = Vec::new();
    if levels > 0 {
        let places = names.iter().map(|name| root.join(name));
        for place in places.filter(|place| place.is_dir()) {
            found.append(&mut folders_with(&place, levels - 1, is_wanted)?);
        }
    }
    Ok(found)
}

/// Numbers of a folder's files `0000000012.EXTENSION`, ascending. Other files are an error: a
/// frame left out unnoticed would tear a sequence.
pub(super) fn frames(folder: &Path, extension: &str) -> Result<Vec<u32>, ReadError> {
    let mut frames = Vec::new();
    for name in names(folder)? {
        if name.starts_with('.') {
            continue; // what file managers leave behind
        }
        let number = name
            .strip_suffix(extension)
            .and_then(|rest| rest.strip_suffix('.'))
            .and_then(frame_number);
        let wanted = || format!("{name:?} is not called like frame 0000000012.{extension}");
        frames.push(number.ok_or_else(|| ReadError::content(folder, wanted()))?);
    }
    Ok(frames)
}

/// Ten digits.
pub(super) fn frame_number(text: &str) -> Option<u32> {
    let is_number = text.len() == 10 && text.bytes().all(|byte| byte.is_ascii_digit());
    is_number.then(|| text.parse().ok())?
}

/// `folder/0000000012.EXTENSION`.
pub(super) fn frame_path(folder: &Path, frame: u32, extension: &str) -> PathBuf {
    folder.join(format!("{frame:010}.{extension}"))
}

/// Finite numbers between white space, `N` of them.
pub(super) fn numbers<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let mut numbers = [0.0; N];
    let mut count = 0;
    for word in text.split_whitespace() {
        let number = word.parse::<f64>().ok().filter(|n| n.is_finite());
        let number = number.ok_or_else(|| format!("{word:?} is no finite number"))?;
        if let Some(place) = numbers.get_mut(count) {
            *place = number;
        }
        count += 1;
    }
    match count == N {
        true => Ok(numbers),
        false => Err(format!("{count} numbers, wanted {N}")),
    }
}
