//! Where decoders put what they find.

use noctule_sensor::{Event, TriggerEdge};

/// Takes events and trigger edges in stream order.
///
/// Decoders hand over a `&mut impl EventSink`, so a consumer is compiled into the decoder's loop.
pub trait EventSink {
    /// Takes one event.
    fn event(&mut self, event: Event);

    /// Takes events that are at hand as a slice, in order. Decoders have them one by one.
    #[inline]
    fn events(&mut self, events: &[Event]) {
        for &event in events {
            self.event(event);
        }
    }

    /// Takes one edge of the trigger input; ignored unless overridden.
    #[inline]
    fn trigger(&mut self, edge: TriggerEdge) {
        let _ = edge;
    }
}

impl EventSink for Vec<Event> {
    #[inline]
    fn event(&mut self, event: Event) {
        self.push(event);
    }

    #[inline]
    fn events(&mut self, events: &[Event]) {
        self.extend_from_slice(events);
    }
}

impl<S: EventSink + ?Sized> EventSink for &mut S {
    #[inline]
    fn event(&mut self, event: Event) {
        (**self).event(event);
    }

    #[inline]
    fn events(&mut self, events: &[Event]) {
        (**self).events(events);
    }

    #[inline]
    fn trigger(&mut self, edge: TriggerEdge) {
        (**self).trigger(edge);
    }
}
