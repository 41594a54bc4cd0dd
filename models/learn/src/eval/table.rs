//! Scores of all methods: kept image by image, averaged, merged and written.
//!
//! The table of single images is the exact record: numbers in it read back to the same bits, so
//! parts of an evaluation merge to exactly the whole.

use std::fmt::Write as _;
use std::path::Path;

use noctule_depth::{Metrics, Score, ScoreTable};
use noctule_world::STEPS;
use serde::Serialize;

use super::error::EvalError;

/// Columns of the table of single images.
const HEADER: &str = "method,params,gmac,image,scene,step,rmse_mm,mae_mm,irmse_per_km,rel,\
    delta1,pixels,edge_mae_mm,mover_mae_mm,thin_mae_mm,temporal_mm,seconds";
const COLUMNS: usize = 17;

/// One method's scores.
#[derive(Debug, Clone, PartialEq)]
pub struct MethodScores {
    /// As tables call it.
    pub method: String,
    /// Trained values.
    pub params: u64,
    /// Multiply-adds per exposure at 256 x 256 pixels, in units of 10^9.
    pub gmac: f64,
    /// Image number: exposure times eight, plus step.
    table: ScoreTable,
    /// Exposure's name and seconds, by image number.
    about: std::collections::BTreeMap<u64, (String, f64)>,
}

/// Scores of all methods over the same images.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Scores {
    methods: Vec<MethodScores>,
}

/// A line of the summary.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// Which method.
    pub method: String,
    /// Images scored: steps of exposures.
    pub images: u64,
    /// Root mean square error, millimetres.
    pub rmse_mm: f64,
    /// Mean absolute error, millimetres.
    pub mae_mm: f64,
    /// Root mean square error of inverse depth, 1/km.
    pub irmse_per_km: f64,
    /// Mean relative error.
    pub rel: f64,
    /// Share of pixels within a factor of 1.25, percent.
    pub delta1: f64,
    /// Mean absolute error within 5 px of depth jumps, millimetres.
    pub edge_mae_mm: Option<f64>,
    /// Mean absolute error on movers, millimetres.
    pub mover_mae_mm: Option<f64>,
    /// Mean absolute error on things under 0.3 m wide, millimetres.
    pub thin_mae_mm: Option<f64>,
    /// Change along the true flow beyond the truth's own, millimetres.
    pub temporal_mm: Option<f64>,
    /// Trained values.
    pub params: u64,
    /// Multiply-adds per exposure, 10^9.
    pub gmac: f64,
    /// Wall-clock seconds per exposure of eight maps.
    pub seconds: f64,
    /// The same numbers by step, 1 first; empty in the rows of single steps.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub per_step: Vec<Row>,
}

impl Scores {
    /// Adds what a method got on one exposure.
    ///
    /// # Errors
    /// [`EvalError::Twice`], when it is there already.
    pub fn add(
        &mut self,
        (method, params, gmac): (&str, u64, f64),
        exposure: usize,
        scene: &str,
        scores: &[Option<Score>; STEPS],
        seconds: f64,
    ) -> Result<(), EvalError> {
        let held = self.method(method, params, gmac);
        for (step, score) in scores.iter().enumerate() {
            if let Some(score) = score {
                held.insert((exposure * STEPS + step) as u64, scene, *score, seconds)?;
            }
        }
        Ok(())
    }

    fn method(&mut self, method: &str, params: u64, gmac: f64) -> &mut MethodScores {
        let known = self.methods.iter().position(|held| held.method == method);
        let place = known.unwrap_or_else(|| {
            self.methods.push(MethodScores {
                method: method.to_owned(),
                params,
                gmac,
                table: ScoreTable::new(),
                about: std::collections::BTreeMap::new(),
            });
            self.methods.len() - 1
        });
        &mut self.methods[place]
    }

    /// One line per method, in the order they came.
    pub fn rows(&self) -> Vec<Row> {
        self.methods.iter().filter_map(MethodScores::row).collect()
    }

    /// The table of single images.
    pub fn per_image_csv(&self) -> String {
        let mut text = format!("{HEADER}\n");
        let write = "writing to a string cannot fail";
        for held in &self.methods {
            for (image, score) in held.table.rows() {
                let (scene, seconds) = &held.about[&image];
                let m = &score.metrics;
                let part = |part: Option<f64>| part.map_or(String::new(), |v| v.to_string());
                writeln!(
                    text,
                    "{},{},{},{image},{scene},{},{},{},{},{},{},{},{},{},{},{},{seconds}",
                    quoted(&held.method),
                    held.params,
                    held.gmac,
                    image % STEPS as u64 + 1,
                    m.rmse_mm,
                    m.mae_mm,
                    m.irmse_per_km,
                    m.rel,
                    m.delta1_pct,
                    m.pixels,
                    part(score.edge_band_mae_mm),
                    part(score.mover_mae_mm),
                    part(score.thin_mae_mm),
                    part(score.temporal_excess_mm),
                )
                .expect(write);
            }
        }
        text
    }

    /// Takes in a table of single images, as [`per_image_csv`](Self::per_image_csv) writes it.
    ///
    /// # Errors
    /// [`EvalError::Table`] for a damaged one, [`EvalError::Twice`] for an image that is here
    /// already.
    pub fn merge_csv(&mut self, text: &str, path: &Path) -> Result<(), EvalError> {
        let fault = |line: usize, fault: &str| EvalError::Table {
            path: path.into(),
            line,
            fault: fault.to_owned(),
        };
        if text.lines().next() != Some(HEADER) {
            return Err(fault(1, "is no table of single images"));
        }
        for (number, line) in (2..).zip(text.lines().skip(1)) {
            let fields = split(line);
            if fields.len() != COLUMNS {
                return Err(fault(number, &format!("{} columns, wanted {COLUMNS}", fields.len())));
            }
            self.take(&fields).map_err(|error| match error {
                Taken::Damaged(column) => fault(number, &format!("{column} is no number")),
                Taken::Refused(error) => error,
            })?;
        }
        Ok(())
    }

    fn take(&mut self, fields: &[String]) -> Result<(), Taken> {
        let number = |column: usize| -> Result<f64, Taken> {
            fields[column].parse().map_err(|_| Taken::Damaged(fields[column].clone()))
        };
        let whole = |column: usize| -> Result<u64, Taken> {
            fields[column].parse().map_err(|_| Taken::Damaged(fields[column].clone()))
        };
        let optional = |column: usize| match fields[column].as_str() {
            "" => Ok(None),
            _ => number(column).map(Some),
        };
        let metrics = Metrics {
            rmse_mm: number(6)?,
            mae_mm: number(7)?,
            irmse_per_km: number(8)?,
            rel: number(9)?,
            delta1_pct: number(10)?,
            pixels: whole(11)?,
        };
        let score = Score {
            metrics,
            edge_band_mae_mm: optional(12)?,
            mover_mae_mm: optional(13)?,
            thin_mae_mm: optional(14)?,
            temporal_excess_mm: optional(15)?,
        };
        self.method(&fields[0], whole(1)?, number(2)?)
            .insert(whole(3)?, &fields[4], score, number(16)?)
            .map_err(Taken::Refused)
    }
}

enum Taken {
    Damaged(String),
    Refused(EvalError),
}

/// Names of methods may hold commas.
fn quoted(text: &str) -> String {
    format!("\"{}\"", text.replace('"', "'"))
}

fn split(line: &str) -> Vec<String> {
    let mut fields = vec![String::new()];
    let mut is_quoted = false;
    for character in line.chars() {
        match character {
            '"' => is_quoted = !is_quoted,
            ',' if !is_quoted => fields.push(String::new()),
            _ => {
                if let Some(field) = fields.last_mut() {
                    field.push(character);
                }
            }
        }
    }
    fields
}

impl MethodScores {
    fn insert(
        &mut self,
        image: u64,
        scene: &str,
        score: Score,
        seconds: f64,
    ) -> Result<(), EvalError> {
        self.table.insert(image, score).map_err(|source| EvalError::Twice {
            method: self.method.clone(),
            source,
        })?;
        self.about.insert(image, (scene.to_owned(), seconds));
        Ok(())
    }

    fn row(&self) -> Option<Row> {
        let per_step = (0..STEPS as u64)
            .filter_map(|step| {
                let mut table = ScoreTable::new();
                for (image, score) in self.table.rows().filter(|(i, _)| i % STEPS as u64 == step) {
                    table.insert(image, *score).ok()?;
                }
                self.line(&table, Vec::new())
            })
            .collect();
        self.line(&self.table, per_step)
    }

    fn line(&self, table: &ScoreTable, per_step: Vec<Row>) -> Option<Row> {
        let mean = table.mean()?;
        let seconds: f64 = table.rows().map(|(image, _)| self.about[&image].1).sum();
        let images = table.rows().len();
        Some(Row {
            method: self.method.clone(),
            images: images as u64,
            rmse_mm: mean.metrics.rmse_mm,
            mae_mm: mean.metrics.mae_mm,
            irmse_per_km: mean.metrics.irmse_per_km,
            rel: mean.metrics.rel,
            delta1: mean.metrics.delta1_pct,
            edge_mae_mm: mean.edge_band_mae_mm,
            mover_mae_mm: mean.mover_mae_mm,
            thin_mae_mm: mean.thin_mae_mm,
            temporal_mm: mean.temporal_excess_mm,
            params: self.params,
            gmac: self.gmac,
            seconds: seconds / images as f64,
            per_step,
        })
    }
}

/// The summary as a table for people.
pub fn markdown(rows: &[Row]) -> String {
    let mut text = String::from(
        "| method | RMSE mm | MAE mm | iRMSE 1/km | REL | d1 % | edge MAE mm | mover MAE mm | \
         thin MAE mm | temporal mm | MAE by step mm | params | GMAC | s |\n\
         |---|---|---|---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    let write = "writing to a string cannot fail";
    for row in rows {
        let part = |part: Option<f64>| part.map_or("-".to_owned(), |v| format!("{v:.0}"));
        let steps: Vec<String> = row.per_step.iter().map(|s| format!("{:.0}", s.mae_mm)).collect();
        writeln!(
            text,
            "| {} | {:.0} | {:.0} | {:.2} | {:.4} | {:.2} | {} | {} | {} | {} | {} | {} | {:.2} | {:.3} |",
            row.method,
            row.rmse_mm,
            row.mae_mm,
            row.irmse_per_km,
            row.rel,
            row.delta1,
            part(row.edge_mae_mm),
            part(row.mover_mae_mm),
            part(row.thin_mae_mm),
            part(row.temporal_mm),
            steps.join(" "),
            row.params,
            row.gmac,
            row.seconds,
        )
        .expect(write);
    }
    text
}

/// The summary as comma-separated values, one line per method and one per step of it.
pub fn csv(rows: &[Row]) -> String {
    let mut text = String::from(
        "method,step,images,rmse_mm,mae_mm,irmse_per_km,rel,delta1,edge_mae_mm,mover_mae_mm,\
         thin_mae_mm,temporal_mm,params,gmac,seconds\n",
    );
    let write = "writing to a string cannot fail";
    let mut line = |step: &str, row: &Row| {
        let part = |part: Option<f64>| part.map_or(String::new(), |v| v.to_string());
        writeln!(
            text,
            "{},{step},{},{},{},{},{},{},{},{},{},{},{},{},{}",
            quoted(&row.method),
            row.images,
            row.rmse_mm,
            row.mae_mm,
            row.irmse_per_km,
            row.rel,
            row.delta1,
            part(row.edge_mae_mm),
            part(row.mover_mae_mm),
            part(row.thin_mae_mm),
            part(row.temporal_mm),
            row.params,
            row.gmac,
            row.seconds,
        )
        .expect(write);
    };
    for row in rows {
        line("all", row);
        for (step, row) in (1..).zip(&row.per_step) {
            line(&step.to_string(), row);
        }
    }
    text
}
