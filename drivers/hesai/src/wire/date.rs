//! The six bytes of date and time, read as nanoseconds since 1970 on the sensor's own clock.
//!
//! No leap seconds and no time zone: whether that clock runs on UTC, on TAI or freely is not in
//! the packet, and not decided here.

use noctule_sensor::{Lidar, Stamp};

const SECOND_NS: u64 = 1_000_000_000;
const DAY_S: u64 = 86_400;

/// Seconds since 1970 of year, month, day, hour, minute, second; `None` if that is no date.
///
/// Both year encodings occur in the field, since 1900 and since 2000: from 70 on it is the
/// former. Year 0 means that the last four bytes are seconds since 1970, big-endian.
pub(crate) fn seconds(bytes: [u8; 6]) -> Option<u64> {
    let [year, month, day, hour, minute, second] = bytes;
    if year == 0 {
        return Some(u64::from(u32::from_be_bytes([day, hour, minute, second])));
    }
    let year = if year >= 70 { 1900 } else { 2000 } + u64::from(year);
    let (month, day) = (u64::from(month), u64::from(day));
    // 60 is a leap second; it reads as the first second of the next minute.
    let valid = (1..=12).contains(&month)
        && (1..=days_in_month(year, month)).contains(&day)
        && hour < 24
        && minute < 60
        && second <= 60;
    valid.then(|| {
        days_since_1970(year, month, day) * DAY_S
            + u64::from(hour) * 3600
            + u64::from(minute) * 60
            + u64::from(second)
    })
}

/// The six bytes and the microseconds of the second, for a stamp in 1970..=2155.
///
/// Years count from 1900, as PandarQT64 does. `None` for a later stamp. What is below a
/// microsecond is cut off.
pub(crate) fn encode(t: Stamp<Lidar>) -> Option<([u8; 6], u32)> {
    let (seconds, nanos) = (t.as_nanos() / SECOND_NS, t.as_nanos() % SECOND_NS);
    let (mut year, mut days) = (1970, seconds / DAY_S);
    while days >= days_in_year(year) {
        days -= days_in_year(year);
        year += 1;
    }
    let mut month = 1;
    while days >= days_in_month(year, month) {
        days -= days_in_month(year, month);
        month += 1;
    }
    let of_day = seconds % DAY_S;
    let byte = |n: u64| u8::try_from(n).ok();
    let date = [
        byte(year - 1900)?,
        byte(month)?,
        byte(days + 1)?,
        byte(of_day / 3600)?,
        byte(of_day / 60 % 60)?,
        byte(of_day % 60)?,
    ];
    Some((date, u32::try_from(nanos / 1000).ok()?))
}

const fn is_leap(year: u64) -> bool {
    year.is_multiple_of(4) && (!year.is_multiple_of(100) || year.is_multiple_of(400))
}

const fn days_in_year(year: u64) -> u64 {
    if is_leap(year) { 366 } else { 365 }
}

const fn days_in_month(year: u64, month: u64) -> u64 {
    match month {
        2 if is_leap(year) => 29,
        2 => 28,
        4 | 6 | 9 | 11 => 30,
        _ => 31,
    }
}

/// Days of a common year before each month.
const MONTH_STARTS: [u64; 12] = [0, 31, 59, 90, 120, 151, 181, 212, 243, 273, 304, 334];

/// Gregorian, for years from 1970 on.
fn days_since_1970(year: u64, month: u64, day: u64) -> u64 {
    let leaps_before = |y: u64| (y - 1) / 4 - (y - 1) / 100 + (y - 1) / 400;
    let years = (year - 1970) * 365 + leaps_before(year) - leaps_before(1970);
    let leap_day = u64::from(month > 2 && is_leap(year));
    years + MONTH_STARTS[usize::try_from(month - 1).unwrap_or(0)] + leap_day + day - 1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_year_encodings_are_the_same_instant() {
        // 2017-09-06 14:31:22, the PandarQT64 capture's second.
        assert_eq!(seconds([117, 9, 6, 14, 31, 22]), Some(1_504_708_282));
        assert_eq!(seconds([17, 9, 6, 14, 31, 22]), Some(1_504_708_282));
        assert_eq!(seconds([70, 1, 1, 0, 0, 0]), Some(0));
        assert_eq!(seconds([69, 1, 1, 0, 0, 0]), Some(3_124_224_000));
    }

    #[test]
    fn year_zero_is_unix_seconds() {
        assert_eq!(seconds([0, 0, 0x59, 0xb0, 0x07, 0xba]), Some(1_504_708_538));
        assert_eq!(seconds([0; 6]), Some(0));
    }

    #[test]
    fn what_is_no_date_is_refused() {
        for bad in [
            [117, 0, 6, 14, 31, 22],
            [117, 13, 6, 14, 31, 22],
            [117, 9, 0, 14, 31, 22],
            [117, 9, 31, 14, 31, 22],
            [117, 2, 29, 14, 31, 22],
            [117, 9, 6, 24, 31, 22],
            [117, 9, 6, 14, 60, 22],
            [117, 9, 6, 14, 31, 61],
        ] {
            assert_eq!(seconds(bad), None, "{bad:?}");
        }
        assert!(seconds([116, 2, 29, 23, 59, 60]).is_some());
    }

    #[test]
    fn what_is_written_reads_back_across_leap_years_and_midnights() {
        for day in (0..65_000).step_by(13) {
            for second in [0, 1, 3_599, 86_399] {
                let t = day * DAY_S + second;
                let stamp = Stamp::from_nanos(t * SECOND_NS + 999_999_999);
                let (bytes, micros) = encode(stamp).unwrap();
                assert_eq!((seconds(bytes), micros), (Some(t), 999_999), "{t}");
            }
        }
        assert_eq!(encode(Stamp::from_nanos(6_000_000_000 * SECOND_NS)), None);
    }
}
