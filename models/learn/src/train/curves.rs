//! The course of a run as tables and as a picture.

use std::fmt::Write as _;
use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use noctule_depth::Canvas;

use super::error::TrainError;
use super::step::Beside;
use super::validate::Validation;

const STEP_HEADER: &str = "stage,step,total,rate,loss,gradient_norm,blurred,spread,seconds";
const VALIDATION_HEADER: &str = "stage,total,score,rmse,mae,edge_mae,mover_mae,thin_mae,mae_mm,\
    last_over_first,picture_loss,picture_blurred,picture_spread,kitti_rmse,kitti_mae,kitti_mae_mm,seconds";
const WIDTH: usize = 900;
const PANEL: usize = 260;
const LEFT: usize = 60;
const PAPER: [u8; 3] = [250, 250, 248];
const INK: [u8; 3] = [60, 62, 66];
const LINES: [[u8; 3]; 4] = [[30, 90, 160], [200, 90, 20], [60, 140, 60], [140, 60, 140]];

/// One step's row.
#[derive(Debug, Clone, Copy)]
pub(super) struct StepRow {
    pub stage: &'static str,
    /// Changes of the weights in the stage and over all stages, this one included.
    pub step: u64,
    pub total: u64,
    pub rate: f64,
    pub loss: f64,
    pub gradient_norm: f64,
    pub beside: Option<Beside>,
    pub seconds: f64,
}

/// The two tables of a run's folder, and what has been drawn from them.
pub(super) struct Curves {
    steps: PathBuf,
    validations: PathBuf,
    picture: PathBuf,
    /// Step and loss; step and the three shares of a validation.
    losses: Vec<(u64, f64)>,
    shares: Vec<(u64, [f64; 3])>,
}

impl Curves {
    /// Opens the tables in `folder`; rows after step `total` belong to work that was lost and are
    /// dropped.
    pub(super) fn open(folder: &Path, total: u64) -> Result<Self, TrainError> {
        let mut curves = Self {
            steps: folder.join("curves.csv"),
            validations: folder.join("validation.csv"),
            picture: folder.join("curves.png"),
            losses: Vec::new(),
            shares: Vec::new(),
        };
        for row in keep_rows(&curves.steps, STEP_HEADER, 2, total)? {
            curves
                .losses
                .push((number(&row, 2) as u64, number(&row, 4)));
        }
        for row in keep_rows(&curves.validations, VALIDATION_HEADER, 1, total)? {
            let shares = [3, 4, 5].map(|column| number(&row, column));
            curves.shares.push((number(&row, 1) as u64, shares));
        }
        Ok(curves)
    }

    pub(super) fn step(&mut self, row: &StepRow) -> Result<(), TrainError> {
        let StepRow {
            stage,
            step,
            total,
            rate,
            loss,
            gradient_norm,
            beside,
            seconds,
        } = row;
        let beside = beside.map_or(",".to_owned(), |b| format!("{},{}", b.blurred, b.spread));
        self.losses.push((*total, *loss));
        let line = format!(
            "{stage},{step},{total},{rate:e},{loss},{gradient_norm},{beside},{seconds:.3}\n"
        );
        append(&self.steps, &line)
    }

    pub(super) fn validation(&mut self, found: &Validation) -> Result<(), TrainError> {
        let mut line = format!("{},{}", found.stage, found.step);
        let write = "writing to a string cannot fail";
        match found.depth {
            Some(d) => {
                let parts = [
                    found.score().unwrap_or(f64::NAN),
                    d.rmse,
                    d.mae,
                    d.edge_mae,
                    d.mover_mae,
                    d.thin_mae,
                    d.mae_mm,
                ];
                parts
                    .iter()
                    .for_each(|p| write!(line, ",{p:.5}").expect(write));
                write!(line, ",{:.5}", d.last_over_first).expect(write);
                self.shares.push((found.step, [d.rmse, d.mae, d.edge_mae]));
            }
            None => line.push_str(",,,,,,,,"),
        }
        match found.pictures {
            Some(p) => write!(line, ",{},{},{}", p.loss, p.blurred, p.spread).expect(write),
            None => line.push_str(",,,"),
        }
        match found.kitti {
            Some(k) => write!(line, ",{:.5},{:.5},{:.5}", k.rmse, k.mae, k.mae_mm).expect(write),
            None => line.push_str(",,,"),
        }
        writeln!(line, ",{:.1}", found.seconds).expect(write);
        append(&self.validations, &line)
    }

    /// Draws losses (logarithmic) above and validation shares below.
    pub(super) fn draw(&self) -> Result<(), TrainError> {
        let mut canvas = Canvas::new(WIDTH, 2 * PANEL + 20, PAPER)?;
        let last = self.losses.last().map_or(1, |(step, _)| *step).max(1);
        canvas.text(LEFT, 8, 1, INK, "LOSS, LOG SCALE, MEAN OF 20 STEPS");
        let smooth: Vec<(u64, f64)> = self
            .losses
            .chunks(20)
            .map(|chunk| {
                let mean = chunk.iter().map(|(_, loss)| loss).sum::<f64>() / chunk.len() as f64;
                (chunk[chunk.len() - 1].0, mean.max(1e-9).log10())
            })
            .collect();
        let label = |value: f64| format!("{:.3}", 10f64.powf(value));
        panel(&mut canvas, 20, last, &[smooth], &label);
        canvas.text(
            LEFT,
            PANEL + 18,
            1,
            INK,
            "ERROR OVER NEAREST: RMSE, MAE, EDGE MAE",
        );
        let series: Vec<Vec<(u64, f64)>> = (0..3)
            .map(|i| self.shares.iter().map(|(step, s)| (*step, s[i])).collect())
            .collect();
        panel(&mut canvas, PANEL + 30, last, &series, &|value| {
            format!("{value:.3}")
        });
        Ok(canvas.save_png(&self.picture)?)
    }
}

/// Draws lines into a box whose vertical range is that of the values.
fn panel(
    canvas: &mut Canvas,
    top: usize,
    last: u64,
    series: &[Vec<(u64, f64)>],
    label: &dyn Fn(f64) -> String,
) {
    let values = || {
        series
            .iter()
            .flatten()
            .map(|(_, v)| *v)
            .filter(|v| v.is_finite())
    };
    let (low, high) = values().fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(v), h.max(v)));
    let (width, height) = (WIDTH - LEFT - 20, PANEL - 40);
    canvas.rect(LEFT, top, 1, height, INK);
    canvas.rect(LEFT, top + height, width, 1, INK);
    if low > high {
        return;
    }
    let span = (high - low).max(1e-9);
    canvas.text(4, top, 1, INK, &label(high));
    canvas.text(4, top + height - 8, 1, INK, &label(low));
    let place = |(step, value): &(u64, f64)| {
        let x = LEFT as f64 + *step as f64 / last as f64 * width as f64;
        let y = top as f64 + (high - value) / span * (height - 2) as f64;
        (x, y)
    };
    for (line, colour) in series.iter().zip(LINES) {
        for pair in line
            .windows(2)
            .filter(|pair| pair.iter().all(|p| p.1.is_finite()))
        {
            let ((x0, y0), (x1, y1)) = (place(&pair[0]), place(&pair[1]));
            let dots = (x1 - x0).abs().max((y1 - y0).abs()).ceil().max(1.0) as usize;
            for dot in 0..=dots {
                let share = dot as f64 / dots as f64;
                let (x, y) = (x0 + share * (x1 - x0), y0 + share * (y1 - y0));
                canvas.rect(x as usize, y as usize, 2, 2, colour);
            }
        }
    }
}

fn number(row: &str, column: usize) -> f64 {
    let field = row.split(',').nth(column).unwrap_or_default();
    field.parse().unwrap_or(f64::NAN)
}

fn append(path: &Path, line: &str) -> Result<(), TrainError> {
    let file = fs::OpenOptions::new().append(true).open(path);
    file.and_then(|mut file| file.write_all(line.as_bytes()))
        .map_err(in_file(path))
}

fn in_file(path: &Path) -> impl FnOnce(std::io::Error) -> TrainError {
    |source| TrainError::File {
        path: path.into(),
        source,
    }
}

/// Rewrites a table with its rows up to step `total`, and returns them.
fn keep_rows(
    path: &Path,
    header: &str,
    column: usize,
    total: u64,
) -> Result<Vec<String>, TrainError> {
    let text = match fs::read_to_string(path) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => String::new(),
        Err(error) => return Err(in_file(path)(error)),
    };
    let rows: Vec<String> = text
        .lines()
        .skip(1)
        .filter(|row| number(row, column) <= total as f64)
        .map(str::to_owned)
        .collect();
    let body: String = rows.iter().map(|row| format!("{row}\n")).collect();
    fs::write(path, format!("{header}\n{body}")).map_err(in_file(path))?;
    Ok(rows)
}
