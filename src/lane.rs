//! The way from one ingest thread to the synchroniser: a bounded queue of pooled blocks.
//!
//! Blocks are made at start-up and lent: the producer takes an empty one, fills it, sends it; the
//! consumer gives it back. Nothing is copied or allocated afterwards. Beside the blocks travels a
//! promise about arrivals, which lets the consumer merge several lanes into one order that does
//! not depend on how threads were scheduled.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::Thread;
use std::time::Duration;

use crossbeam::queue::ArrayQueue;
use noctule_sensor::{Realtime, Stamp};

/// What a producer does when the consumer holds every block.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WhenFull {
    /// Waits: a recording can be held back.
    Wait,
    /// Loses the newest and counts it: a device cannot.
    Lose,
}

#[derive(Debug)]
struct Shared<T> {
    full: ArrayQueue<Box<T>>,
    empty: ArrayQueue<Box<T>>,
    /// INVARIANT: every block whose arrival is earlier than this was pushed before it was stored.
    promised: AtomicU64,
    closed: AtomicBool,
    abandoned: AtomicBool,
    lost: AtomicU64,
    consumer: Thread,
}

/// A lane of `capacity` blocks whose consumer runs on the thread `consumer`.
pub fn lane<T>(
    capacity: usize,
    consumer: Thread,
    make: impl Fn() -> T,
) -> (Producer<T>, Consumer<T>) {
    let empty = ArrayQueue::new(capacity);
    for _ in 0..capacity {
        // The queue has room for exactly as many.
        let _ = empty.push(Box::new(make()));
    }
    let shared = Arc::new(Shared {
        full: ArrayQueue::new(capacity),
        empty,
        promised: AtomicU64::new(0),
        closed: AtomicBool::new(false),
        abandoned: AtomicBool::new(false),
        lost: AtomicU64::new(0),
        consumer,
    });
    (
        Producer {
            shared: Arc::clone(&shared),
        },
        Consumer { shared },
    )
}

/// The filling end.
#[derive(Debug)]
pub struct Producer<T> {
    shared: Arc<Shared<T>>,
}

impl<T> Producer<T> {
    /// An empty block; `None` when there is none and none is waited for, or when the consumer is
    /// gone.
    #[must_use]
    pub fn lease(&mut self, when_full: WhenFull) -> Option<Box<T>> {
        loop {
            if let Some(block) = self.shared.empty.pop() {
                return Some(block);
            }
            if when_full == WhenFull::Lose || self.shared.abandoned.load(Ordering::Relaxed) {
                return None;
            }
            // The consumer may be asleep with work in its hands; it wakes by itself within its
            // own bound, so a short sleep here is enough.
            std::thread::sleep(Duration::from_micros(100));
        }
    }

    /// Hands a filled block over.
    pub fn push(&mut self, block: Box<T>) {
        // There are as many places as blocks, so this cannot be refused.
        let refused = self.shared.full.push(block);
        debug_assert!(refused.is_ok(), "more blocks than places");
        self.shared.consumer.unpark();
    }

    /// Gives an unused block back.
    pub fn give_back(&mut self, block: Box<T>) {
        let refused = self.shared.empty.push(block);
        debug_assert!(refused.is_ok(), "more blocks than places");
    }

    /// Promises that no block pushed from now on arrived before `arrival`.
    pub fn promise(&mut self, arrival: Stamp<Realtime>) {
        // Release pairs with the Acquire in `Consumer::promised`.
        self.shared
            .promised
            .store(arrival.as_nanos(), Ordering::Release);
        self.shared.consumer.unpark();
    }

    /// Counts samples that found no block.
    pub fn count_lost(&mut self, samples: u64) {
        self.shared.lost.fetch_add(samples, Ordering::Relaxed);
    }

    /// Whether the consumer is gone.
    #[must_use]
    pub fn is_abandoned(&self) -> bool {
        self.shared.abandoned.load(Ordering::Relaxed)
    }
}

impl<T> Drop for Producer<T> {
    fn drop(&mut self) {
        // Release pairs with the Acquire in `Consumer::is_closed`.
        self.shared.closed.store(true, Ordering::Release);
        self.shared.consumer.unpark();
    }
}

/// The emptying end.
#[derive(Debug)]
pub struct Consumer<T> {
    shared: Arc<Shared<T>>,
}

impl<T> Consumer<T> {
    /// The oldest filled block.
    pub fn pop(&mut self) -> Option<Box<T>> {
        self.shared.full.pop()
    }

    /// Gives a block back to the producer.
    pub fn give_back(&mut self, block: Box<T>) {
        let refused = self.shared.empty.push(block);
        debug_assert!(refused.is_ok(), "more blocks than places");
    }

    /// The newest promise. Read it *before* finding the lane empty: then no block that arrived
    /// earlier than it can follow.
    #[must_use]
    pub fn promised(&self) -> Stamp<Realtime> {
        Stamp::from_nanos(self.shared.promised.load(Ordering::Acquire))
    }

    /// Whether the producer is gone. As with promises, read it before finding the lane empty.
    #[must_use]
    pub fn is_closed(&self) -> bool {
        self.shared.closed.load(Ordering::Acquire)
    }

    /// Samples the producer lost for want of a block.
    #[must_use]
    pub fn lost(&self) -> u64 {
        self.shared.lost.load(Ordering::Relaxed)
    }
}

impl<T> Drop for Consumer<T> {
    fn drop(&mut self) {
        self.shared.abandoned.store(true, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_come_back_in_order_and_none_is_made_later() {
        let (mut producer, mut consumer) = lane(2, std::thread::current(), || 0_u32);
        for value in [1, 2] {
            let mut block = producer.lease(WhenFull::Lose).unwrap();
            *block = value;
            producer.push(block);
        }
        assert!(producer.lease(WhenFull::Lose).is_none());
        let first = consumer.pop().unwrap();
        assert_eq!(*first, 1);
        consumer.give_back(first);
        assert!(producer.lease(WhenFull::Lose).is_some());
        assert_eq!(consumer.pop().as_deref(), Some(&2));
        assert!(consumer.pop().is_none());
    }

    #[test]
    fn a_waiting_producer_leaves_when_its_consumer_is_gone() {
        let (mut producer, consumer) = lane(1, std::thread::current(), || ());
        let held = producer.lease(WhenFull::Wait);
        assert!(held.is_some());
        drop(consumer);
        assert!(producer.lease(WhenFull::Wait).is_none());
    }

    #[test]
    fn nothing_earlier_follows_a_promise() {
        const BLOCKS: u64 = 20_000;
        let (mut producer, mut consumer) = lane(8, std::thread::current(), || 0_u64);
        let feeder = std::thread::spawn(move || {
            for arrival in 1..=BLOCKS {
                producer.promise(Stamp::from_nanos(arrival));
                let mut block = producer.lease(WhenFull::Wait).unwrap();
                *block = arrival;
                producer.push(block);
            }
        });
        let (mut floor, mut seen) = (0, 0);
        loop {
            let closed = consumer.is_closed();
            let promised = consumer.promised().as_nanos();
            match consumer.pop() {
                Some(block) => {
                    assert!(*block >= floor, "{} after a promise of {floor}", *block);
                    seen += 1;
                    consumer.give_back(block);
                }
                None if closed => break,
                None => floor = floor.max(promised),
            }
        }
        feeder.join().unwrap();
        assert_eq!(seen, BLOCKS);
    }
}
