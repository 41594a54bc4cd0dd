//! EVT 3.0 decoding at its plainest, written apart from the decoder it is compared with.

use noctule_evk4::ErrorCounts;
use noctule_sensor::{Event, Stamp, TriggerEdge};

/// One thing found in a stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Item {
    /// A pixel's event.
    Event(Event),
    /// A trigger edge.
    Edge(TriggerEdge),
}

/// Everything found, in stream order.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Items(pub Vec<Item>);

impl noctule_evk4::EventSink for Items {
    fn event(&mut self, event: Event) {
        self.0.push(Item::Event(event));
    }

    fn trigger(&mut self, edge: TriggerEdge) {
        self.0.push(Item::Edge(edge));
    }
}

/// What [`decode_evt3`] finds.
#[derive(Debug, Default)]
pub struct Model {
    /// Events and edges.
    pub items: Items,
    /// Errors by kind.
    pub errors: ErrorCounts,
    /// Words without fault.
    pub decoded: u64,
    /// Words with an event outside.
    pub out_of_bounds_words: u64,
}

/// Decodes a whole stream, word by word.
pub fn decode_evt3(bytes: &[u8], width: u64, height: u64) -> Model {
    let mut m = Model::default();
    let (mut loops, mut high, mut low) = (0_u64, None::<u64>, 0_u64);
    let (mut row, mut base) = (None::<u64>, None::<(u64, bool)>);
    m.errors.trailing_bytes = (bytes.len() % 2) as u64;
    for pair in bytes.chunks_exact(2) {
        let word = u64::from(pair[0]) + 256 * u64::from(pair[1]);
        let (kind, value) = (word / 4096, word % 4096);
        let (address, flag) = (value % 2048, value >= 2048);
        if kind == 8 {
            let old = high.replace(value);
            let back = old.is_some_and(|old| value < old);
            if old.is_some_and(|old| value + 2048 <= old) {
                loops += 1;
                m.decoded += 1;
            } else if back {
                m.errors.time_backwards += 1;
            } else {
                m.decoded += 1;
            }
            if old != Some(value) {
                low = 0;
            }
            continue;
        }
        let Some(high) = high else {
            m.errors.before_first_time_high += 1;
            continue;
        };
        let t = Stamp::from_micros(((loops * 4096) + high) * 4096 + low);
        let pixels: Vec<(u64, bool)> = match kind {
            0 => {
                row = Some(address);
                vec![]
            }
            2 => vec![(address, flag)],
            3 => {
                base = Some((address, flag));
                vec![]
            }
            4 | 5 => {
                let len = if kind == 4 { 12 } else { 8 };
                match base {
                    None if row.is_some() => {
                        m.errors.missing_vect_base += 1;
                        continue;
                    }
                    None => vec![],
                    Some((x, on)) => {
                        base = Some((x + len, on));
                        let set = (0..len).filter(|bit| value >> bit & 1 == 1);
                        set.map(|bit| (x + bit, on)).collect()
                    }
                }
            }
            6 => {
                if value < low {
                    m.errors.time_backwards += 1;
                } else {
                    m.decoded += 1;
                }
                low = value;
                continue;
            }
            10 => {
                m.items.0.push(Item::Edge(TriggerEdge {
                    t,
                    channel: u8::try_from(value >> 8).expect("4 bits"),
                    rising: value % 2 == 1,
                }));
                vec![]
            }
            7 | 14 | 15 => vec![],
            _ => {
                m.errors.reserved_word += 1;
                continue;
            }
        };
        if matches!(kind, 2 | 4 | 5) && row.is_none() {
            m.errors.missing_y += 1;
            continue;
        }
        let y = row.unwrap_or(0);
        let count = pixels.len();
        let inside = pixels.into_iter().filter(|(x, _)| *x < width && y < height);
        let inside: Vec<_> = inside.collect();
        if inside.len() < count {
            m.errors.out_of_bounds += (count - inside.len()) as u64;
            m.out_of_bounds_words += 1;
        } else {
            m.decoded += 1;
        }
        for (x, on) in inside {
            let x = u16::try_from(x).expect("inside the sensor");
            let y = u16::try_from(y).expect("11 bits");
            m.items.0.push(Item::Event(Event { t, x, y, on }));
        }
    }
    m
}
