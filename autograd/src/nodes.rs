//! The nodes of a tape: a list that grows without moving its entries, so that a node can be read while others are
//! added.

use std::cell::{OnceCell, RefCell};

/// Stands for an input that is no node.
pub(crate) const CONSTANT: u32 = u32::MAX;

/// The storage of a node; None after it was freed.
type Place<N> = RefCell<Option<N>>;

/// Nodes in the first chunk; each further chunk is twice as long.
const FIRST: usize = 16;
const CHUNKS: usize = 29;

/// Nodes in the order in which they were added, each with its inputs.
pub(crate) struct Nodes<N> {
    chunks: [OnceCell<Box<[Place<N>]>>; CHUNKS],
    edges: RefCell<Edges>,
}

/// For each node its input nodes, one after another. The list is compact, since a backward pass reads it first to find
/// the nodes to visit. Entries stay when a node is freed.
#[derive(Default)]
pub(crate) struct Edges {
    ends: Vec<u32>,
    inputs: Vec<u32>,
}

impl Edges {
    /// Number of nodes.
    pub fn len(&self) -> usize {
        self.ends.len()
    }

    /// The inputs of a node; an input may be [`CONSTANT`].
    #[inline]
    pub fn of(&self, node: u32) -> &[u32] {
        let node = node as usize;
        let start = if node == 0 { 0 } else { self.ends[node - 1] };
        &self.inputs[start as usize..self.ends[node] as usize]
    }
}

impl<N> Nodes<N> {
    pub fn new() -> Self {
        Nodes { chunks: [const { OnceCell::new() }; CHUNKS], edges: RefCell::default() }
    }

    /// Number of nodes, including freed ones.
    pub fn len(&self) -> usize {
        self.edges.borrow().len()
    }

    /// Runs `f` on the edges. No node can be added meanwhile.
    pub fn with_edges<R>(&self, f: impl FnOnce(&Edges) -> R) -> R {
        f(&self.edges.borrow())
    }

    /// The storage of a node that was added.
    #[track_caller]
    pub fn place(&self, node: u32) -> &Place<N> {
        let (chunk, offset) = locate(node as usize);
        match self.chunks[chunk].get() {
            Some(chunk) => &chunk[offset],
            None => unreachable!("a node that was never added"),
        }
    }

    /// Adds a node with these inputs, and returns its number.
    ///
    /// # Panics
    /// If there are 2^32 - 1 nodes or inputs.
    pub fn push(&self, node: N, inputs: impl Iterator<Item = u32>) -> u32 {
        let mut edges = self.edges.borrow_mut();
        let index = edges.len();
        let (chunk, offset) = locate(index);
        edges.inputs.extend(inputs);
        let (Ok(number), Ok(end)) = (u32::try_from(index), u32::try_from(edges.inputs.len())) else {
            panic!("a tape holds less than 2^32 operations and inputs: clear it between steps");
        };
        assert!(number != CONSTANT, "a tape holds less than 2^32 operations: clear it between steps");
        edges.ends.push(end);
        let chunk = self.chunks[chunk].get_or_init(|| (0..FIRST << chunk).map(|_| RefCell::new(None)).collect());
        *chunk[offset].borrow_mut() = Some(node);
        number
    }

    /// Frees the contents of a node; its number and its edges stay. A reader of the node frees it afterwards.
    pub fn free(&self, node: u32) {
        if let Ok(mut place) = self.place(node).try_borrow_mut() {
            *place = None;
        }
    }

    /// Frees the contents of every node that `which` selects, as [`free`](Self::free) does.
    pub fn free_those(&self, which: impl Fn(&N) -> bool) {
        for node in 0..self.len() as u32 {
            if let Ok(mut place) = self.place(node).try_borrow_mut() {
                place.take_if(|node| which(node));
            }
        }
    }

    /// Removes every node, and keeps the memory for as many.
    pub fn clear(&mut self) {
        let edges = self.edges.get_mut();
        let mut left = edges.len();
        for (i, chunk) in self.chunks.iter_mut().enumerate() {
            let used = left.min(FIRST << i);
            left -= used;
            if used == 0 {
                chunk.take();
            } else if let Some(chunk) = chunk.get_mut() {
                chunk[..used].iter_mut().for_each(|place| *place.get_mut() = None);
            }
        }
        edges.ends.clear();
        edges.inputs.clear();
    }
}

/// The chunk that holds a node, and its place there.
#[inline]
fn locate(node: usize) -> (usize, usize) {
    let chunk = (node / FIRST + 1).ilog2() as usize;
    (chunk, node + FIRST - (FIRST << chunk))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_node_has_a_place_of_its_own() {
        let mut expected = (0, 0);
        for node in 0..100_000 {
            assert_eq!(locate(node), expected);
            expected.1 += 1;
            if expected.1 == FIRST << expected.0 {
                expected = (expected.0 + 1, 0);
            }
        }
        let (chunk, offset) = locate(CONSTANT as usize);
        assert!(chunk < CHUNKS && offset < FIRST << chunk);
    }
}
