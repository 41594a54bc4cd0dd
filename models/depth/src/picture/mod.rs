//! Pictures of depth, error and events: colours, labels, contact sheets, PNG. Measures nothing.

mod canvas;
mod colour;
mod depth_png;
mod font;
mod legend;
mod maps;
mod png_file;
mod scale;
mod sheet;

pub use canvas::{CANVAS_SIDE_MAX, Canvas, PictureError};
pub use colour::Ramp;
pub use depth_png::{
    DepthImage, DepthPngError, load_depth_png16, read_depth_png16, save_depth_png16,
    write_depth_png16,
};
pub use font::{LINE_HEIGHT, text_width};
pub use legend::Legend;
pub use maps::{depth_to_rgb, error_to_rgb, events_to_rgb, sparse_to_rgb};
pub use png_file::PngError;
pub use scale::{INVALID_RGB, Scale};
pub use sheet::ContactSheet;
