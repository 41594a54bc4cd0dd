//! One channel: loans out, samples in, a wake-up beside them.

use std::cell::Cell;
use std::time::Duration;

use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::ZeroCopySend;
use iceoryx2::sample::Sample;
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::service::Service;
use iceoryx2::service::port_factory::{event, publish_subscribe};

use super::{BusError, ChannelLimits};
use crate::frame::{Block, BundleHeader, DepthHeader};

/// A header that travels beside a payload and counts the frames of its channel.
pub trait Header: ZeroCopySend + Default + Copy + std::fmt::Debug + 'static {
    /// The service's name on the bus.
    const SERVICE: &'static str;
    /// Counts frames; receivers see loss as gaps.
    fn frame(&self) -> u64;
}

impl Header for BundleHeader {
    const SERVICE: &'static str = "bundle";
    fn frame(&self) -> u64 {
        self.sequence
    }
}

impl Header for DepthHeader {
    const SERVICE: &'static str = "depth";
    fn frame(&self) -> u64 {
        self.frame
    }
}

/// The services of one channel.
#[derive(Debug)]
pub(super) struct Channel<S: Service, H: Header> {
    pub data: publish_subscribe::PortFactory<S, [Block], H>,
    pub wake: event::PortFactory<S>,
    pub limits: ChannelLimits,
}

/// The sending end of a channel; stays on the thread that made it.
#[derive(Debug)]
pub struct Sender<S: Service, H: Header> {
    publisher: Publisher<S, [Block], H>,
    notifier: Notifier<S>,
    blocks: usize,
}

/// Shared memory on loan: written in place, then sent or dropped.
#[derive(Debug)]
pub struct Loan<S: Service, H: Header> {
    sample: SampleMut<S, [Block], H>,
}

impl<S: Service, H: Header> Loan<S, H> {
    /// The header, to be written.
    pub fn header_mut(&mut self) -> &mut H {
        self.sample.user_header_mut()
    }

    /// The payload, zeroed when it was loaned.
    pub fn payload_mut(&mut self) -> &mut [Block] {
        self.sample.payload_mut()
    }
}

impl<S: Service, H: Header> Sender<S, H> {
    pub(super) fn open(channel: &Channel<S, H>) -> Result<Self, BusError> {
        let publisher = channel
            .data
            .publisher_builder()
            .initial_max_slice_len(channel.limits.blocks)
            .max_loaned_samples(channel.limits.loans)
            .create()
            .map_err(|e| BusError::transport("creating a publisher")(&e))?;
        let notifier = channel
            .wake
            .notifier_builder()
            .create()
            .map_err(|e| BusError::transport("creating a notifier")(&e))?;
        let sender = Self {
            publisher,
            notifier,
            blocks: channel.limits.blocks,
        };
        sender.touch(channel.limits.loans)?;
        Ok(sender)
    }

    /// Writes to as many samples as may be on loan at once, so that no page faults later.
    fn touch(&self, loans: usize) -> Result<(), BusError> {
        let held: Result<Vec<_>, _> = (0..loans).map(|_| self.loan()).collect();
        held.map(drop)
    }

    /// Borrows a zeroed sample.
    ///
    /// # Errors
    /// When all samples are on loan or in receivers' hands.
    pub fn loan(&self) -> Result<Loan<S, H>, BusError> {
        let sample = self
            .publisher
            .loan_slice_uninit(self.blocks)
            .map_err(|e| BusError::transport("borrowing a sample")(&e))?
            .write_from_fn(|_| Block::ZERO);
        Ok(Loan { sample })
    }

    /// Sends the sample and wakes the receivers; returns how many it was queued for.
    ///
    /// # Errors
    /// When the transport fails.
    pub fn send(&self, loan: Loan<S, H>) -> Result<usize, BusError> {
        let receivers = loan
            .sample
            .send()
            .map_err(|e| BusError::transport("sending a sample")(&e))?;
        // A receiver that vanished between the two calls is no error of the sender's.
        if let Err(error) = self.notifier.notify() {
            tracing::debug!("waking receivers: {error:?}");
        }
        Ok(receivers)
    }
}

/// A sample in a receiver's hands; the memory goes back when it is dropped.
#[derive(Debug)]
pub struct Received<S: Service, H: Header> {
    sample: Sample<S, [Block], H>,
}

impl<S: Service, H: Header> Received<S, H> {
    /// What the frame says about itself.
    #[must_use]
    pub fn header(&self) -> &H {
        self.sample.user_header()
    }

    /// The blocks, in place.
    #[must_use]
    pub fn payload(&self) -> &[Block] {
        self.sample.payload()
    }
}

/// The newest queued sample.
#[derive(Debug)]
pub struct Newest<S: Service, H: Header> {
    /// The sample.
    pub frame: Received<S, H>,
    /// How many older ones were passed over for it.
    pub passed_over: u64,
}

/// The receiving end of a channel; stays on the thread that made it.
#[derive(Debug)]
pub struct Receiver<S: Service, H: Header> {
    subscriber: Subscriber<S, [Block], H>,
    listener: Listener<S>,
    next: Cell<Option<u64>>,
    received: Cell<u64>,
    lost: Cell<u64>,
}

impl<S: Service, H: Header> Receiver<S, H> {
    pub(super) fn open(channel: &Channel<S, H>) -> Result<Self, BusError> {
        let subscriber = channel
            .data
            .subscriber_builder()
            .create()
            .map_err(|e| BusError::transport("creating a subscriber")(&e))?;
        let listener = channel
            .wake
            .listener_builder()
            .create()
            .map_err(|e| BusError::transport("creating a listener")(&e))?;
        Ok(Self {
            subscriber,
            listener,
            next: Cell::new(None),
            received: Cell::new(0),
            lost: Cell::new(0),
        })
    }

    /// The oldest queued frame, if any.
    ///
    /// # Errors
    /// When the transport fails or too many frames are held.
    pub fn receive(&self) -> Result<Option<Received<S, H>>, BusError> {
        let sample = self
            .subscriber
            .receive()
            .map_err(|e| BusError::transport("receiving a sample")(&e))?;
        Ok(sample.map(|sample| {
            let received = Received { sample };
            self.count(received.header().frame());
            received
        }))
    }

    /// The newest queued frame.
    ///
    /// # Errors
    /// When the transport fails.
    pub fn receive_newest(&self) -> Result<Option<Newest<S, H>>, BusError> {
        let Some(mut frame) = self.receive()? else {
            return Ok(None);
        };
        let mut passed_over = 0;
        while let Some(newer) = self.receive()? {
            frame = newer;
            passed_over += 1;
        }
        Ok(Some(Newest { frame, passed_over }))
    }

    /// Sleeps until something was sent or `limit` has passed.
    ///
    /// # Errors
    /// When the transport fails.
    pub fn wait(&self, limit: Duration) -> Result<(), BusError> {
        match self.listener.timed_wait(|_| {}, limit) {
            // A signal is a reason to look up, not a failure: its handler has set a flag.
            Ok(_) | Err(ListenerWaitError::InterruptSignal) => Ok(()),
            Err(error) => Err(BusError::transport("waiting for a sample")(&error)),
        }
    }

    fn count(&self, frame: u64) {
        self.received.set(self.received.get() + 1);
        if let Some(expected) = self.next.get()
            && frame > expected
        {
            self.lost.set(self.lost.get() + (frame - expected));
        }
        // A lower number than expected is a sender that was restarted: count on from there.
        self.next.set(Some(frame + 1));
    }

    /// Frames received so far.
    #[must_use]
    pub fn received(&self) -> u64 {
        self.received.get()
    }

    /// Frames that were sent and overwritten before this receiver took them.
    #[must_use]
    pub fn lost(&self) -> u64 {
        self.lost.get()
    }
}
