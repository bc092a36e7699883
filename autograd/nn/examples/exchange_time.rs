//! Compares the time of an exchange over TCP with its simulation.
//!
//! Ranks in this process gather messages from each other over real TCP connections, which a relay slows down to a rate
//! and a delay. `cargo run --release -p raygrad-nn --example exchange_time -- [KILOBYTES] [ROUNDS]` prints the time of an
//! exchange, that of the simulation, and the difference.

use raygrad_nn::{Exchange, Link, Simulated, Tcp};
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::mpsc::{Receiver, channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// Bytes that the relay passes on at a time.
const CHUNK: usize = 1 << 16;
/// A lane that has been free for less than this was busy: the relay's thread woke up late.
const LATE: Duration = Duration::from_micros(200);

/// One direction of the link of a rank: when it is free.
type Lane = Arc<Mutex<Instant>>;

/// Sends bytes that are here through a lane; returns when they are through.
fn pass(lane: &Lane, bytes: usize, link: Link) -> Instant {
    let (mut free, now) = (lane.lock().unwrap(), Instant::now());
    let start = if now.saturating_duration_since(*free) < LATE { *free } else { now };
    *free = start + Duration::from_secs_f64(bytes as f64 / link.bandwidth);
    *free
}

fn sleep_until(time: Instant) {
    std::thread::sleep(time.saturating_duration_since(Instant::now()));
}

/// Passes bytes of one direction of a connection on, through the sender's and the receiver's lane.
fn relay(mut from: TcpStream, mut to: TcpStream, [out, into]: [Lane; 2], link: Link) {
    let (sender, chunks) = channel::<(Instant, Vec<u8>)>();
    std::thread::spawn(move || {
        for (due, chunk) in chunks {
            sleep_until(due);
            if to.write_all(&chunk).is_err() {
                return;
            }
        }
    });
    std::thread::spawn(move || {
        let mut chunk = vec![0; CHUNK];
        while let Ok(len @ 1..) = from.read(&mut chunk) {
            sleep_until(pass(&out, len, link));
            // The receiver takes bytes while they are sent, unless others send to it at the same time.
            let mut free = into.lock().unwrap();
            let due = Instant::now().max(*free + Duration::from_secs_f64(len as f64 / link.bandwidth));
            *free = due;
            drop(free);
            if sender.send((due + link.latency, chunk[..len].to_vec())).is_err() {
                return;
            }
        }
    });
}

/// What a rank that calls says first, and its number in there.
fn caller(stream: &mut TcpStream) -> ([u8; 24], usize) {
    let mut greeting = [0; 24];
    stream.read_exact(&mut greeting).unwrap();
    (greeting, u64::from_le_bytes(greeting[8..16].try_into().unwrap()) as usize)
}

/// Relays all connections to a rank.
fn relay_to(rank: usize, address: SocketAddr, lanes: Arc<Vec<[Lane; 2]>>, link: Link) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let relayed = listener.local_addr().unwrap();
    std::thread::spawn(move || {
        for _ in rank + 1..lanes.len() {
            let mut incoming = listener.accept().unwrap().0;
            let mut outgoing = TcpStream::connect(address).unwrap();
            incoming.set_nodelay(true).unwrap();
            outgoing.set_nodelay(true).unwrap();
            let (greeting, other) = caller(&mut incoming);
            outgoing.write_all(&greeting).unwrap();
            let [there, back] = [(other, rank), (rank, other)].map(|(a, b)| [lanes[a][0].clone(), lanes[b][1].clone()]);
            relay(incoming.try_clone().unwrap(), outgoing.try_clone().unwrap(), there, link);
            relay(outgoing, incoming, back, link);
        }
    });
    relayed
}

/// Runs `rounds` exchanges on each rank, and returns the longest time of one.
fn time<E: Exchange>(ranks: Vec<E>, bytes: usize, rounds: u32, clock: impl Fn(&E) -> Duration + Sync) -> Duration {
    let run = |mut exchange: E| {
        // The first one waits for threads and buffers.
        exchange.all_gather(&vec![0; bytes]).unwrap();
        let start = clock(&exchange);
        for _ in 0..rounds {
            exchange.all_gather(&vec![0; bytes]).unwrap();
        }
        (clock(&exchange) - start) / rounds
    };
    std::thread::scope(|scope| {
        let run = &run;
        let threads: Vec<_> = ranks.into_iter().map(|exchange| scope.spawn(move || run(exchange))).collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).max().unwrap()
    })
}

/// Ranks that are connected through a relay.
fn connected(count: usize, link: Link) -> Vec<Tcp> {
    let lanes =
        Arc::new((0..count).map(|_| [(); 2].map(|()| Lane::new(Mutex::new(Instant::now())))).collect::<Vec<_>>());
    let listeners: Vec<_> = (0..count).map(|_| TcpListener::bind("127.0.0.1:0").unwrap()).collect();
    let relayed =
        |(rank, listener): (usize, &TcpListener)| relay_to(rank, listener.local_addr().unwrap(), lanes.clone(), link);
    let addresses: Arc<Vec<_>> = Arc::new(listeners.iter().enumerate().map(relayed).collect());
    let (sender, done): (_, Receiver<(usize, Tcp)>) = channel();
    for (rank, listener) in listeners.into_iter().enumerate() {
        let (sender, addresses) = (sender.clone(), addresses.clone());
        std::thread::spawn(move || {
            let tcp = Tcp::with_listener(rank, listener, &addresses, Duration::from_secs(30)).unwrap();
            sender.send((rank, tcp)).unwrap();
        });
    }
    drop(sender);
    let mut ranks: Vec<_> = done.iter().collect();
    ranks.sort_by_key(|(rank, _)| *rank);
    ranks.into_iter().map(|(_, tcp)| tcp).collect()
}

fn main() {
    let mut arguments = std::env::args().skip(1).map(|text| text.parse::<usize>().expect("a number"));
    let (kilobytes, rounds) = (arguments.next().unwrap_or(700), arguments.next().unwrap_or(20) as u32);
    println!(
        "{kilobytes} kB from each rank to each other\n\n| ranks | Mbit/s | delay, ms | TCP, ms | simulated, ms | difference |"
    );
    println!("|--:|--:|--:|--:|--:|--:|");
    for ranks in [2, 4] {
        for megabits in [100.0, 300.0, 1000.0] {
            for delay in [0.1, 1.0, 10.0] {
                let latency = Duration::from_secs_f64(1e-3 * delay);
                let link = Link { latency, bandwidth: megabits * 1e6 / 8.0, loss: 0.0 };
                let start = Instant::now();
                let tcp = time(connected(ranks, link), 1000 * kilobytes, rounds, |_| start.elapsed());
                let simulated = time(Simulated::ranks(ranks, link), 1000 * kilobytes, rounds, Simulated::elapsed);
                let [tcp, simulated] = [tcp, simulated].map(|time| 1e3 * time.as_secs_f64());
                let difference = 100.0 * (tcp / simulated - 1.0);
                println!("| {ranks} | {megabits} | {delay} | {tcp:.2} | {simulated:.2} | {difference:+.1} % |");
            }
        }
    }
}
