//! Scores and times both completions on made-up streets, and draws them on a contact sheet.
//!
//! ```text
//! cargo run --release -p noctule-depth --example completion_report -- sheet.png [KITTI_ROOT]
//! ```
//!
//! With a folder in the layout of the KITTI depth benchmark, the pictures of its
//! `val_selection_cropped` are scored as well, on the pixels whose ring was held out.
#![allow(clippy::print_stdout, reason = "a report is printed")]
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a picture of bytes"
)]

#[path = "../tests/street/mod.rs"]
mod street;

use noctule_depth::{
    Canvas, Completer, ContactSheet, Legend, Metrics, Scale, Score, ScoreTable, Size, depth_to_rgb,
    edge_band, error_to_rgb, load_depth_png16, masked_mae, metrics, sparse_to_rgb,
};
use std::error::Error;
use std::path::Path;
use std::time::Instant;
use street::{SIDE, Street};

/// Seeds of the streets that are scored.
const SEEDS: std::ops::Range<u64> = 101..125;
/// Streets drawn on the sheet.
const DRAWN: usize = 4;
const D_MIN_M: f32 = 0.1;
const CAP_M: f32 = 80.0;
/// Error at the ends of the error ramp, metres.
const ERROR_FULL_M: f32 = 20.0;

struct Case {
    truth: Vec<f32>,
    sparse: Vec<f32>,
    nearest: Vec<f32>,
    fill: Vec<f32>,
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let sheet = arguments
        .next()
        .ok_or("usage: completion_report SHEET.png [KITTI_ROOT]")?;
    let cases = SEEDS.map(street_case).collect::<Result<Vec<_>, _>>()?;
    let size = Size::new(SIDE, SIDE)?;
    println!("{} streets of {SIDE}x{SIDE}, cap {CAP_M} m", cases.len());
    report(
        "nearest",
        cases.iter().map(|case| (&case.nearest, &case.truth)),
        size,
    )?;
    report(
        "fill",
        cases.iter().map(|case| (&case.fill, &case.truth)),
        size,
    )?;
    time(&cases[0].sparse)?;
    if let Some(root) = arguments.next() {
        kitti(Path::new(&root))?;
    }
    draw(&cases[..DRAWN], size)?.save_png(&sheet)?;
    println!("drew {sheet}");
    Ok(())
}

fn street_case(seed: u64) -> Result<Case, Box<dyn Error>> {
    let mut street = Street::new(seed);
    let (truth, sparse) = (street.truth(), street.sparse());
    let mut completer = Completer::new(SIDE, SIDE)?;
    let (mut nearest, mut fill) = (vec![0.0; SIDE * SIDE], vec![0.0; SIDE * SIDE]);
    let mut aside = vec![0.0; SIDE * SIDE];
    completer.nearest(&sparse, &mut nearest, &mut aside)?;
    completer.fill(&sparse, &mut fill, &mut aside)?;
    Ok(Case {
        truth,
        sparse,
        nearest,
        fill,
    })
}

fn report<'a>(
    name: &str,
    pairs: impl Iterator<Item = (&'a Vec<f32>, &'a Vec<f32>)>,
    size: Size,
) -> Result<(), Box<dyn Error>> {
    let mut table = ScoreTable::new();
    let mut mask = vec![false; size.pixels()];
    for (index, (pred, truth)) in (0..).zip(pairs) {
        edge_band(truth, size, &mut mask)?;
        let band = masked_mae(pred, truth, &mask, D_MIN_M, CAP_M)?;
        let all = metrics(pred, truth, D_MIN_M, CAP_M)?;
        let edge_band_mae_mm = band.map(|band| band.mae_mm);
        table.insert(
            index,
            Score {
                edge_band_mae_mm,
                ..Score::from(all)
            },
        )?;
    }
    let mean = table.mean().ok_or("no image was scored")?;
    println!(
        "{name:>8}: {}, edge band MAE {:.0} mm",
        line(mean.metrics),
        mean.edge_band_mae_mm.unwrap_or(0.0)
    );
    Ok(())
}

fn line(m: Metrics) -> String {
    format!(
        "RMSE {:.0} mm, MAE {:.0} mm, iRMSE {:.2} 1/km, REL {:.4}, d1 {:.2} %",
        m.rmse_mm, m.mae_mm, m.irmse_per_km, m.rel, m.delta1_pct
    )
}

fn time(sparse: &[f32]) -> Result<(), Box<dyn Error>> {
    let mut completer = Completer::new(SIDE, SIDE)?;
    let (mut depth, mut aside) = (vec![0.0; SIDE * SIDE], vec![0.0; SIDE * SIDE]);
    let mut median_us = |run: &mut dyn FnMut(&mut Completer)| {
        let mut spent: Vec<_> = (0..201)
            .map(|_| {
                let started = Instant::now();
                run(&mut completer);
                started.elapsed().as_micros()
            })
            .collect();
        spent.sort_unstable();
        spent[spent.len() / 2]
    };
    let nearest_us = median_us(&mut |c| {
        c.nearest(sparse, &mut depth, &mut aside)
            .expect("sizes agree")
    });
    let fill_us = median_us(&mut |c| c.fill(sparse, &mut depth, &mut aside).expect("sizes agree"));
    println!("median of 201 runs, one thread: nearest {nearest_us} us, fill {fill_us} us");
    Ok(())
}

/// Held-out rings: `velodyne_raw` keeps every fourth, truth is scored where it has none.
fn kitti(root: &Path) -> Result<(), Box<dyn Error>> {
    let folder = root.join("depth_selection/val_selection_cropped");
    let mut truths: Vec<_> = std::fs::read_dir(folder.join("groundtruth_depth"))?
        .map(|entry| entry.map(|entry| entry.path()))
        .collect::<Result<_, _>>()?;
    truths.sort();
    let mut tables = [ScoreTable::new(), ScoreTable::new()];
    for (index, path) in (0..).zip(&truths) {
        let name = path
            .file_name()
            .and_then(|name| name.to_str())
            .ok_or("a file name")?;
        let sparse_name = name.replace("groundtruth_depth", "velodyne_raw");
        let sparse = load_depth_png16(folder.join("velodyne_raw").join(sparse_name))?;
        let mut truth = load_depth_png16(path)?.depth_m;
        for (truth, &given) in truth.iter_mut().zip(&sparse.depth_m) {
            if given > 0.0 {
                *truth = 0.0;
            }
        }
        let mut completer = Completer::new(sparse.width, sparse.height)?;
        let (mut depth, mut aside) = (vec![0.0; truth.len()], vec![0.0; truth.len()]);
        completer.nearest(&sparse.depth_m, &mut depth, &mut aside)?;
        tables[0].insert(index, metrics(&depth, &truth, D_MIN_M, CAP_M)?.into())?;
        completer.fill(&sparse.depth_m, &mut depth, &mut aside)?;
        tables[1].insert(index, metrics(&depth, &truth, D_MIN_M, CAP_M)?.into())?;
    }
    println!(
        "{} pictures of {}, 16 rings given, 48 scored",
        truths.len(),
        folder.display()
    );
    for (name, table) in ["nearest", "fill"].iter().zip(&tables) {
        println!(
            "{name:>8}: {}",
            line(table.mean().ok_or("no picture")?.metrics)
        );
    }
    Ok(())
}

fn draw(cases: &[Case], size: Size) -> Result<Canvas, Box<dyn Error>> {
    let mut sheet = ContactSheet::new("Depth without a network", SIDE, SIDE, 1)?;
    sheet.note("made-up streets, 64-channel LiDAR, 256 x 256 pixels");
    let tile = |paint: &dyn Fn(&mut [u8]) -> Result<(), noctule_depth::SizeError>| {
        let mut canvas = Canvas::new(SIDE, SIDE, [0; 3])?;
        paint(canvas.rgb_mut())?;
        Ok::<_, Box<dyn Error>>(canvas)
    };
    for (seed, case) in SEEDS.zip(cases) {
        sheet.row(&format!("street {seed}"));
        let mae = |depth: &[f32]| -> Result<String, Box<dyn Error>> {
            Ok(format!(
                "MAE {:.2} m",
                metrics(depth, &case.truth, D_MIN_M, CAP_M)?.mae_mm / 1000.0
            ))
        };
        let returns = case.sparse.iter().filter(|&&depth| depth > 0.0).count();
        sheet.tile(
            &format!("{returns} returns"),
            tile(&|rgb| sparse_to_rgb(&case.sparse, size, 1, Scale::DRIVE, rgb))?,
        )?;
        for (name, depth) in [("nearest", &case.nearest), ("fill", &case.fill)] {
            sheet.tile(name, tile(&|rgb| depth_to_rgb(depth, Scale::DRIVE, rgb))?)?;
        }
        sheet.tile(
            "truth",
            tile(&|rgb| depth_to_rgb(&case.truth, Scale::DRIVE, rgb))?,
        )?;
        for (name, depth) in [("nearest", &case.nearest), ("fill", &case.fill)] {
            let label = format!("{name} {}", mae(depth)?);
            sheet.tile(
                &label,
                tile(&|rgb| error_to_rgb(depth, &case.truth, ERROR_FULL_M, rgb))?,
            )?;
        }
    }
    sheet.legend(Legend::depth(Scale::DRIVE));
    sheet.legend(Legend::error(ERROR_FULL_M));
    Ok(sheet.render()?)
}
