//! Who creates the services, and how the others find them.

use std::time::Duration;

use iceoryx2::prelude::{Node, NodeBuilder, ServiceName, SignalHandlingMode};
use iceoryx2::service::Service;

use super::channel::Channel;
use super::limits::{ChannelLimits, Limits};
use super::{BusError, Header, Instance, Receiver, Sender};
use crate::frame::{Block, BundleHeader, DepthHeader};

/// Creates an instance's services, holds them, and removes what is left when it is dropped.
#[derive(Debug)]
pub struct Owner<S: Service> {
    // Dropped first: the sweep in `drop` of `Sweeper` must find no live port.
    ports: Ports<S>,
    _sweeper: Sweeper,
}

#[derive(Debug)]
struct Sweeper(Instance);

impl Drop for Sweeper {
    fn drop(&mut self) {
        self.0.sweep();
    }
}

impl<S: Service> Owner<S> {
    /// Creates the services of `instance`, after clearing away what a crashed one left.
    ///
    /// # Errors
    /// When the instance is already running or shared memory has no room.
    pub fn create(instance: Instance, limits: Limits) -> Result<Self, BusError> {
        Instance::require_room(limits.bundle.bytes() + limits.depth.bytes())?;
        let node = node::<S>(&instance, "owner")?;
        node.blocking_cleanup_dead_nodes(Duration::from_secs(2));
        let sweeper = Sweeper(instance.clone());
        let bundle = create::<S, BundleHeader>(&instance, &node, limits.bundle);
        let bundle = match bundle {
            Err(BusError::Running(name)) => {
                // The files belong to somebody who is alive.
                std::mem::forget(sweeper);
                return Err(BusError::Running(name));
            }
            other => other?,
        };
        let depth = create::<S, DepthHeader>(&instance, &node, limits.depth)?;
        Ok(Self {
            ports: Ports {
                instance,
                node,
                bundle,
                depth,
            },
            _sweeper: sweeper,
        })
    }

    /// The owner's own ports.
    #[must_use]
    pub fn ports(&self) -> &Ports<S> {
        &self.ports
    }

    /// Clears away what crashed processes of the instance left; returns how many.
    pub fn clean_dead(&self) -> usize {
        usize::try_from(self.ports.node.try_cleanup_dead_nodes().cleanups).unwrap_or(usize::MAX)
    }
}

/// An instance's services, opened.
#[derive(Debug)]
pub struct Ports<S: Service> {
    // Channels before the node they were opened through.
    bundle: Channel<S, BundleHeader>,
    depth: Channel<S, DepthHeader>,
    node: Node<S>,
    instance: Instance,
}

impl<S: Service> Ports<S> {
    /// Opens the services that an [`Owner`] created; `name` says who is there.
    ///
    /// # Errors
    /// When there are none.
    pub fn open(instance: Instance, name: &str, limits: Limits) -> Result<Self, BusError> {
        if !instance.root().exists() {
            // Opening a node would create the folder, and nobody would own it.
            return Err(BusError::NotRunning {
                instance: instance.name().to_string(),
                service: BundleHeader::SERVICE,
            });
        }
        let node = node::<S>(&instance, name)?;
        let bundle = open::<S, BundleHeader>(&instance, &node, limits.bundle)?;
        let depth = open::<S, DepthHeader>(&instance, &node, limits.depth)?;
        Ok(Self {
            bundle,
            depth,
            node,
            instance,
        })
    }

    /// The instance they belong to.
    #[must_use]
    pub fn instance(&self) -> &Instance {
        &self.instance
    }

    /// Receivers of bundles there are now, dead ones that nobody has cleared away included.
    #[must_use]
    pub fn bundle_receivers(&self) -> usize {
        use iceoryx2::service::port_factory::PortFactory as _;
        self.bundle.data.dynamic_config().number_of_subscribers()
    }

    /// Sends bundles.
    ///
    /// # Errors
    /// When another process already does.
    pub fn bundle_sender(&self) -> Result<Sender<S, BundleHeader>, BusError> {
        Sender::open(&self.bundle)
    }

    /// Receives bundles.
    ///
    /// # Errors
    /// When there are too many receivers.
    pub fn bundle_receiver(&self) -> Result<Receiver<S, BundleHeader>, BusError> {
        Receiver::open(&self.bundle)
    }

    /// Sends depth frames.
    ///
    /// # Errors
    /// When another process already does.
    pub fn depth_sender(&self) -> Result<Sender<S, DepthHeader>, BusError> {
        Sender::open(&self.depth)
    }

    /// Receives depth frames.
    ///
    /// # Errors
    /// When there are too many receivers.
    pub fn depth_receiver(&self) -> Result<Receiver<S, DepthHeader>, BusError> {
        Receiver::open(&self.depth)
    }
}

fn node<S: Service>(instance: &Instance, name: &str) -> Result<Node<S>, BusError> {
    let transport = BusError::transport("creating a node");
    let config = instance.config()?;
    NodeBuilder::new()
        .name(
            &name
                .try_into()
                .map_err(|_| BusError::Name(name.to_owned()))?,
        )
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<S>()
        .map_err(|e| transport(&e))
}

fn service_name<H: Header>() -> Result<ServiceName, BusError> {
    ServiceName::new(H::SERVICE).map_err(|e| BusError::transport("naming a service")(&e))
}

fn create<S: Service, H: Header>(
    instance: &Instance,
    node: &Node<S>,
    limits: ChannelLimits,
) -> Result<Channel<S, H>, BusError> {
    use iceoryx2::service::builder::publish_subscribe::PublishSubscribeCreateError as Refused;
    let name = service_name::<H>()?;
    let data = node
        .service_builder(&name)
        .publish_subscribe::<[Block]>()
        .user_header::<H>()
        // Two, so that a restarted sender need not wait for its dead twin to be cleared away.
        .max_publishers(2)
        .max_subscribers(limits.receivers)
        .subscriber_max_buffer_size(limits.queue)
        .subscriber_max_borrowed_samples(limits.held)
        .history_size(0)
        .enable_safe_overflow(true)
        .max_nodes(16)
        .create()
        .map_err(|e| match e {
            Refused::AlreadyExists => BusError::Running(instance.name().to_string()),
            other => BusError::transport("creating a service")(&other),
        })?;
    let wake = node
        .service_builder(&name)
        .event()
        .max_listeners(limits.receivers)
        .max_notifiers(2)
        .max_nodes(16)
        .create()
        .map_err(|e| BusError::transport("creating an event service")(&e))?;
    Ok(Channel { data, wake, limits })
}

fn open<S: Service, H: Header>(
    instance: &Instance,
    node: &Node<S>,
    limits: ChannelLimits,
) -> Result<Channel<S, H>, BusError> {
    use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenError as Refused;
    let name = service_name::<H>()?;
    let data = node
        .service_builder(&name)
        .publish_subscribe::<[Block]>()
        .user_header::<H>()
        .open()
        .map_err(|e| match e {
            Refused::DoesNotExist => BusError::NotRunning {
                instance: instance.name().to_string(),
                service: H::SERVICE,
            },
            other => BusError::transport("opening a service")(&other),
        })?;
    let wake = node
        .service_builder(&name)
        .event()
        .open()
        .map_err(|e| BusError::transport("opening an event service")(&e))?;
    Ok(Channel { data, wake, limits })
}
