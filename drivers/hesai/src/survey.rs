//! What a capture holds, without being told which sensor made it.

use std::collections::BTreeMap;
use std::io::Read;

use noctule_sensor::{Lidar, Return, Stamp};

use crate::pcap::{CaptureError, Reader};
use crate::wire::{
    Counts, Decoder, Model, Options, OptionsError, Packet, PacketError, Rejected, Returns,
};

/// What was found in a stream of datagrams.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Summary {
    /// The sensor; `None` when no datagram was a packet of a known one.
    pub model: Option<Model>,
    /// UDP port it sends to; `None` as above.
    pub port: Option<u16>,
    /// Totals of its packets. Without a sensor, `rejected` says why.
    pub counts: Counts,
    /// Datagrams to other ports.
    pub other_ports: u64,
    /// When the earliest non-zero return was fired.
    pub first: Option<Stamp<Lidar>>,
    /// When the latest non-zero return was fired.
    pub last: Option<Stamp<Lidar>>,
}

/// Finds out which sensor sends, then decodes all it sends.
///
/// The first valid packet decides the model and the port; what came before it on other ports is
/// no concern of the sensor.
#[derive(Debug, Clone, Default)]
pub struct Survey {
    sensor: Option<(u16, Decoder)>,
    /// What was refused before the sensor was known, by port.
    refused: BTreeMap<u16, Rejected>,
    other_ports: u64,
    span: Option<(Stamp<Lidar>, Stamp<Lidar>)>,
}

impl Survey {
    /// A survey for any sensor, with nominal tables.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// A survey of a sensor that is known, with its own tables, sending to `port`.
    ///
    /// # Errors
    /// When the settings contradict one another.
    pub fn of(port: u16, options: Options) -> Result<Self, OptionsError> {
        let options = Options {
            returns: Returns::All,
            ..options
        };
        Ok(Self {
            sensor: Some((port, Decoder::new(options)?)),
            ..Self::default()
        })
    }

    /// Takes note of one datagram.
    pub fn datagram(&mut self, port: u16, payload: &[u8]) {
        if self.sensor.is_none() {
            match recognise(payload) {
                Ok(decoder) => self.sensor = Some((port, decoder)),
                Err(error) => {
                    self.refused.entry(port).or_default().add(&error);
                    return;
                }
            }
        }
        let Some((of, decoder)) = &mut self.sensor else {
            return;
        };
        if *of != port {
            self.other_ports += 1;
            return;
        }
        let span = &mut self.span;
        // What is wrong with a packet, the decoder counts.
        let _counted = decoder.decode(payload, &mut |r: Return, _sweep| {
            let (first, last) = span.get_or_insert((r.t, r.t));
            *first = r.t.min(*first);
            *last = r.t.max(*last);
        });
    }

    /// Takes note of every datagram of a capture that is left.
    ///
    /// # Errors
    /// Where and why the capture cannot be read on; what came before is taken note of.
    pub fn read<R: Read>(&mut self, reader: &mut Reader<R>) -> Result<(), CaptureError> {
        while let Some(datagram) = reader.next_datagram()? {
            self.datagram(datagram.dst_port, datagram.payload);
        }
        Ok(())
    }

    /// What was found so far.
    #[must_use]
    pub fn summary(&self) -> Summary {
        let (port, decoder) = match &self.sensor {
            Some((port, decoder)) => (Some(*port), Some(decoder)),
            None => (None, None),
        };
        let mut counts = decoder.map_or_else(Counts::default, |decoder| *decoder.counts());
        let mut other_ports = self.other_ports;
        for (refused_port, refused) in &self.refused {
            if port.is_none_or(|port| port == *refused_port) {
                counts.rejected.merge(refused);
            } else {
                other_ports += refused.total();
            }
        }
        Summary {
            model: decoder.map(|decoder| decoder.options().model),
            port,
            counts,
            other_ports,
            first: self.span.map(|(first, _)| first),
            last: self.span.map(|(_, last)| last),
        }
    }
}

/// A decoder for the sensor that sent `payload`.
fn recognise(payload: &[u8]) -> Result<Decoder, PacketError> {
    let model = Model::identify(payload)?;
    Packet::new(model, payload)?;
    let options = Options {
        returns: Returns::All,
        ..Options::new(model)
    };
    Ok(Decoder::new(options).expect("nominal tables are the model's"))
}
