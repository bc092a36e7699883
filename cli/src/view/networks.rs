//! Shares of connections. A network with many connections shuts no other one out.

use std::collections::VecDeque;
use std::future::Future;
use std::net::{IpAddr, Ipv6Addr};

use tokio::task::AbortHandle;

/// Where connections come from: an IPv4 address, or the network of an IPv6 address (its first 64 bits), since a host
/// chooses the rest freely.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Network(IpAddr);

impl Network {
    #[cfg(test)]
    pub const LOCAL: Network = Network(IpAddr::V4(std::net::Ipv4Addr::LOCALHOST));

    /// The network of a connection from this address.
    pub fn of(address: IpAddr) -> Self {
        Network(match address.to_canonical() {
            IpAddr::V6(ip) => IpAddr::V6(Ipv6Addr::from_bits(ip.to_bits() >> 64 << 64)),
            v4 => v4,
        })
    }
}

/// The network with the most connections after a new one; among equals, that of the new one.
pub fn largest(networks: impl Iterator<Item = Network>, new: Network) -> Network {
    let mut counts = vec![(new, 1)];
    for network in networks {
        match counts.iter_mut().find(|(known, _)| *known == network) {
            Some((_, count)) => *count += 1,
            None => counts.push((network, 1)),
        }
    }
    counts.into_iter().rev().max_by_key(|(_, count)| *count).map_or(new, |(network, _)| network)
}

/// Connections that are not pages, oldest first.
///
/// A new connection is always accepted. Beyond the limit, it ends the oldest one of the network with the most. So
/// connections that send no request do not delay the others.
pub struct Connections {
    limit: usize,
    open: VecDeque<(Network, AbortHandle)>,
}

impl Connections {
    pub fn new(limit: usize) -> Self {
        Connections { limit, open: VecDeque::new() }
    }

    /// Serves a connection in a task of its own.
    pub fn spawn(&mut self, network: Network, task: impl Future<Output = ()> + Send + 'static) {
        self.open.retain(|(_, task)| !task.is_finished());
        if self.open.len() >= self.limit {
            let crowd = largest(self.open.iter().map(|(network, _)| *network), network);
            let oldest = self.open.iter().position(|(network, _)| *network == crowd);
            if let Some((_, task)) = oldest.and_then(|oldest| self.open.remove(oldest)) {
                task.abort();
            }
        }
        self.open.push_back((network, tokio::spawn(task).abort_handle()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn network(address: &str) -> Network {
        Network::of(address.parse().unwrap())
    }

    #[test]
    fn network_of_ipv6_is_its_network() {
        assert_eq!(network("2001:db8:1:2:3:4:5:6"), network("2001:db8:1:2::9"));
        assert_ne!(network("2001:db8:1:2::9"), network("2001:db8:1:3::9"));
        assert_ne!(network("10.0.0.1"), network("10.0.0.2"));
        assert_eq!(network("::ffff:10.0.0.1"), network("10.0.0.1"));
        assert_eq!(network("127.0.0.1"), Network::LOCAL);
    }

    #[test]
    fn largest_prefers_the_new_network_among_equals() {
        let [a, b, c] = ["10.0.0.1", "10.0.0.2", "10.0.0.3"].map(network);
        assert_eq!(largest([].into_iter(), c), c);
        assert_eq!(largest([a, b, a].into_iter(), c), a);
        assert_eq!(largest([a, b, a].into_iter(), b), b, "two each");
        assert_eq!(largest([a, b, a].into_iter(), a), a);
        assert_eq!(largest([a, b].into_iter(), c), c, "one each");
    }

    #[tokio::test]
    async fn crowded_network_loses_its_oldest_connection() {
        let [crowd, other] = ["10.0.0.1", "10.0.0.2"].map(network);
        let mut connections = Connections::new(4);
        let handles = |connections: &Connections| {
            connections.open.iter().map(|(network, task)| (*network, task.clone())).collect::<Vec<_>>()
        };
        for network in [other, crowd, crowd, crowd] {
            connections.spawn(network, std::future::pending());
        }
        let before = handles(&connections);
        connections.spawn(other, std::future::pending());
        tokio::task::yield_now().await;
        assert_eq!(before.iter().map(|(_, task)| task.is_finished()).collect::<Vec<_>>(), [false, true, false, false]);
        // Now both networks have two, so a newcomer replaces one of its own.
        connections.spawn(other, std::future::pending());
        tokio::task::yield_now().await;
        assert_eq!(before.iter().map(|(_, task)| task.is_finished()).collect::<Vec<_>>(), [true, true, false, false]);
        // Ended connections count no more.
        handles(&connections).iter().for_each(|(_, task)| task.abort());
        tokio::task::yield_now().await;
        connections.spawn(crowd, async {});
        assert_eq!(connections.open.len(), 1);
    }
}
