//! What changes when the synthesis makes anything otherwise.

use noctule_depth::Size;

use crate::clip::PERIOD_US;
use crate::synth::{Footage, Synthesis, expose};

/// Changes when the synthesis makes anything otherwise: an exposure of a small moving pattern.
pub(super) fn fingerprint() -> Vec<u8> {
    let size = Size::new(32, 24).expect("a size");
    let frame = |shift: usize| -> Vec<u8> {
        let cells = (0..24_usize).flat_map(|y| (0..32_usize).map(move |x| (x + 2 * shift, y)));
        let code = |(x, y): (usize, usize)| (((x * x + 5 * x * y + 3 * y) / 4) % 200) as u8;
        cells.flat_map(|cell| [code(cell); 3]).collect()
    };
    let frames: Vec<Vec<u8>> = (0..3).map(frame).collect();
    let footage = Footage::from_srgb(frames.iter().map(Vec::as_slice), size, PERIOD_US);
    let footage = footage.expect("small and whole");
    let exposed = expose(&footage, 0.0, 2.0, &Synthesis::of_seed(1)).expect("within the footage");
    let mut bytes = exposed.blur;
    bytes.extend(exposed.sharp);
    for event in exposed.events {
        bytes.extend(event.t_us.to_le_bytes());
        bytes.extend([event.x() as u8, event.y() as u8, u8::from(event.is_on())]);
    }
    bytes
}
