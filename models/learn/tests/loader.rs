//! Examples and batches: kept without loss, the same in every run, from any batch on.
#![allow(clippy::unwrap_used, reason = "a test may fail by panicking")]

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use noctule_learn::{
    Augment, Batch, Cache, CacheError, Example, Kind, Loader, Loss, Nights, Origin, Recipe,
    SHARD_LEN, Stage,
};
use noctule_world::Tier;

const SIZE: usize = 32;

fn nights() -> Vec<Nights> {
    let range = |tier, seeds| Nights { tier, seeds };
    vec![range(Tier::A, 3..6), range(Tier::S, 40..42)]
}

fn prepared(root: &Path) -> Cache {
    let cache = Cache::new(root, SIZE).unwrap();
    cache
        .prepare(&nights(), &AtomicBool::new(false), &mut |_| {})
        .unwrap();
    cache
}

fn recipe(cache: &Cache, kind: Kind) -> Recipe {
    Recipe {
        examples: Arc::new(cache.open(&nights()).unwrap()),
        size: SIZE,
        stage: Stage {
            kind,
            steps: 10,
            batch: 2,
            crop: 16,
            window: 4,
            rate: [1e-3, 0.0],
            warm_up: 0,
            clip_norm: None,
            validate_every: 1,
            checkpoint_every: 1,
            collapse_margin: 1.0,
            go_on_collapsed: true,
            loss: None,
        },
        augment: Augment {
            flip: 0.5,
            event_drop_max: 0.3,
            event_noise_max: 0.1,
            return_drop_max: 0.3,
            gain: [0.5, 2.0],
            ..Augment::default()
        },
        loss: Loss {
            depth_edges: 1.0,
            ..Loss::default()
        },
        seed: [11, 0],
        depth_max_m: 80.0,
    }
}

fn take(recipe: &Recipe, first: u64, threads: usize, count: usize) -> Vec<Batch> {
    let mut loader = Loader::new(Arc::new(recipe.clone()), first, threads);
    (0..count).map(|_| loader.next_batch().unwrap()).collect()
}

#[test]
fn an_example_comes_back_from_disk_as_it_was_rendered() {
    let root = tempfile::tempdir().unwrap();
    let examples = prepared(root.path()).open(&nights()).unwrap();
    assert_eq!(examples.len(), 5);
    for (index, &(origin, seed)) in examples.places().iter().enumerate() {
        let Origin::Night(tier) = origin else {
            panic!("{origin:?}")
        };
        let rendered = Example::render(seed, tier, SIZE).unwrap();
        assert!(rendered.events.len() > 20 && rendered.sparse.iter().any(|d| *d > 0.0));
        assert_eq!(examples.read(index, true).unwrap(), rendered);
        assert!(examples.read(index, false).unwrap().sharp.is_empty());
    }
}

#[test]
fn what_is_on_disk_is_not_rendered_again_and_a_stop_keeps_it() {
    let root = tempfile::tempdir().unwrap();
    let cache = Cache::new(root.path(), SIZE).unwrap();
    let many = vec![Nights {
        tier: Tier::A,
        seeds: 0..SHARD_LEN + 2,
    }];
    let stop = AtomicBool::new(false);
    let stopped = cache.prepare(&many, &stop, &mut |now| {
        assert_eq!((now.done, now.rendered), (SHARD_LEN, SHARD_LEN));
        stop.store(true, Ordering::Relaxed);
    });
    assert!(matches!(stopped, Err(CacheError::Interrupted)));
    assert!(matches!(cache.open(&many), Err(CacheError::File { .. })));
    let mut last = None;
    let go_on = AtomicBool::new(false);
    cache
        .prepare(&many, &go_on, &mut |now| last = Some(now))
        .unwrap();
    let last = last.unwrap();
    assert_eq!(
        (last.rendered, last.done, last.total),
        (2, SHARD_LEN + 2, SHARD_LEN + 2)
    );
    cache.open(&many).unwrap();
}

#[test]
fn a_damaged_shard_is_named() {
    let root = tempfile::tempdir().unwrap();
    let cache = prepared(root.path());
    let path = cache.folder().join("A-000003-000006.safetensors");
    let bytes = std::fs::read(&path).unwrap();
    for len in [0, 7, 100, bytes.len() / 2, bytes.len() - 1] {
        std::fs::write(&path, &bytes[..len]).unwrap();
        let error = cache.open(&nights()).unwrap_err().to_string();
        assert!(error.contains("A-000003-000006"), "{len}: {error}");
    }
    let mut damaged = bytes;
    damaged[..8].copy_from_slice(&u64::MAX.to_le_bytes());
    std::fs::write(&path, &damaged).unwrap();
    assert!(matches!(
        cache.open(&nights()),
        Err(CacheError::Shard { .. })
    ));
}

#[test]
fn batches_do_not_depend_on_threads_or_on_where_one_starts() {
    let root = tempfile::tempdir().unwrap();
    let cache = prepared(root.path());
    for kind in [Kind::Restore, Kind::Complete] {
        let recipe = recipe(&cache, kind);
        let all = take(&recipe, 0, 1, 7);
        assert_eq!(take(&recipe, 0, 3, 7), all);
        // Batch 3 starts within the second epoch: five examples, two to a batch.
        assert_eq!(take(&recipe, 3, 2, 4), all[3..]);
        assert_ne!(all[0].places, all[1].places);
        let other = Recipe {
            seed: [12, 0],
            ..recipe
        };
        assert_ne!(take(&other, 0, 1, 1)[0], all[0]);
    }
}

#[test]
fn an_unvaried_batch_is_the_example() {
    let root = tempfile::tempdir().unwrap();
    let cache = prepared(root.path());
    let mut recipe = recipe(&cache, Kind::Complete);
    recipe.augment = Augment::default();
    recipe.stage.crop = SIZE;
    recipe.stage.window = 8;
    let batch = take(&recipe, 0, 1, 1).remove(0);
    let inputs = batch.to_device(&candle_core::Device::Cpu).unwrap();
    let (letter, seed) = batch.places[0];
    let tier = letter.to_string().parse().unwrap();
    let example = Example::render(seed, tier, SIZE).unwrap();
    let first = |tensor: &candle_core::Tensor| -> Vec<f32> {
        tensor
            .get(0)
            .unwrap()
            .flatten_all()
            .unwrap()
            .to_vec1()
            .unwrap()
    };
    assert_eq!(first(&inputs.sparse), example.sparse);
    let codes: Vec<f32> = example.blur.iter().map(|&b| f32::from(b) / 255.0).collect();
    assert_eq!(first(&inputs.blur), codes);
    let known = |d: &f32| if *d <= 80.0 { *d } else { 0.0 };
    let truth: Vec<f32> = example.depth.iter().map(known).collect();
    assert_eq!(first(&inputs.depth), truth);
    // Every event weighs a tenth in all; nothing is clamped in so small a picture unless dense.
    let total: f32 = first(&inputs.voxel).iter().sum();
    let signed: i32 = example
        .events
        .iter()
        .map(|e| if e.is_on() { 1 } else { -1 })
        .sum();
    assert!(
        (total - signed as f32 / 10.0).abs() < 2.0,
        "{total} {signed}"
    );
    assert!(inputs.pictures.is_none() && inputs.edges.is_some());
}

#[test]
fn losing_events_and_returns_loses_them() {
    let root = tempfile::tempdir().unwrap();
    let cache = prepared(root.path());
    let mut plain = recipe(&cache, Kind::Complete);
    plain.augment = Augment::default();
    let mut varied = plain.clone();
    varied.augment.return_drop_max = 1.0;
    varied.augment.event_drop_max = 1.0;
    let count = |recipe: &Recipe| {
        take(recipe, 0, 1, 4)
            .iter()
            .map(|batch| {
                let inputs = batch.to_device(&candle_core::Device::Cpu).unwrap();
                let set = |x: &candle_core::Tensor| {
                    let values: Vec<f32> = x.flatten_all().unwrap().to_vec1().unwrap();
                    values.iter().filter(|v| **v != 0.0).count()
                };
                (set(&inputs.sparse), set(&inputs.voxel))
            })
            .fold((0, 0), |(a, b), (c, d)| (a + c, b + d))
    };
    let (all, some) = (count(&plain), count(&varied));
    assert!(
        some.0 * 10 < all.0 * 9 && some.1 * 10 < all.1 * 9,
        "{some:?} of {all:?}"
    );
    assert!(some.0 > 0 && some.1 > 0);
}

#[test]
fn crops_over_movers_show_more_of_them() {
    let root = tempfile::tempdir().unwrap();
    let cache = prepared(root.path());
    let mut anywhere = recipe(&cache, Kind::Complete);
    anywhere.augment = Augment::default();
    anywhere.stage.crop = 8;
    anywhere.loss.depth_movers = 1.0;
    let mut over = anywhere.clone();
    over.augment.over_movers = 1.0;
    let seen = |recipe: &Recipe| -> f32 {
        let share = |batch: &Batch| {
            let inputs = batch.to_device(&candle_core::Device::Cpu).unwrap();
            let movers = inputs.movers.unwrap().mean_all().unwrap();
            movers.to_scalar::<f32>().unwrap()
        };
        take(recipe, 0, 1, 30).iter().map(share).sum()
    };
    let (anywhere, over) = (seen(&anywhere), seen(&over));
    assert!(anywhere > 0.0 && over > 1.5 * anywhere, "{over} {anywhere}");
}
