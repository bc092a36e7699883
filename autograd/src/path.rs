//! The path of a backward pass: the nodes between a root and the variables whose gradients are wanted.

use crate::nodes::{CONSTANT, Nodes};

/// The nodes that the root depends on, from the root down to the lowest wanted variable. Finding them takes time in
/// proportion to their inputs, for any length of the tape.
pub(crate) struct Path {
    /// Highest first: a node comes before its inputs.
    nodes: Vec<u32>,
    marks: Vec<Mark>,
    /// For each of `nodes` its place in it. Entries of other nodes are left over from earlier passes (a sparse set,
    /// Briggs and Torczon 1993), so that no pass has to clear them.
    places: Vec<u32>,
}

#[derive(Clone, Copy, Default)]
struct Mark {
    /// Whether its own gradient is wanted.
    wanted: bool,
    /// Whether an input of it is wanted, or leads to a wanted node.
    leads: bool,
}

impl Path {
    /// The path from `root` to the nodes `wanted`, which may be anywhere on the tape. `scratch` is empty, or comes from
    /// [`into_scratch`] of a path of the same tape.
    ///
    /// [`into_scratch`]: Self::into_scratch
    pub fn new<N>(nodes: &Nodes<N>, scratch: Vec<u32>, root: u32, wanted: impl Iterator<Item = u32> + Clone) -> Self {
        let bottom = wanted.clone().min().unwrap_or(CONSTANT);
        let mut path = Path { nodes: vec![], marks: vec![], places: scratch };
        nodes.with_edges(|edges| {
            path.places.resize(edges.len().max(path.places.len()), 0);
            path.add(root, bottom);
            let mut next = 0;
            while let Some(&node) = path.nodes.get(next) {
                edges.of(node).iter().for_each(|&input| path.add(input, bottom));
                next += 1;
            }
            path.nodes.sort_unstable_by(|a, b| b.cmp(a));
            for (place, &node) in path.nodes.iter().enumerate() {
                path.places[node as usize] = place as u32;
            }
            path.marks.resize(path.nodes.len(), Mark::default());
            for node in wanted {
                if let Some(place) = path.place(node) {
                    path.marks[place].wanted = true;
                }
            }
            for place in (0..path.nodes.len()).rev() {
                path.marks[place].leads = edges.of(path.nodes[place]).iter().any(|&input| path.needs(input));
            }
        });
        path
    }

    fn add(&mut self, node: u32, bottom: u32) {
        if node != CONSTANT && node >= bottom && self.place(node).is_none() {
            self.places[node as usize] = self.nodes.len() as u32;
            self.nodes.push(node);
        }
    }

    /// The nodes, highest first.
    pub fn nodes(&self) -> &[u32] {
        &self.nodes
    }

    /// The place of a node in [`nodes`](Self::nodes).
    #[inline]
    pub fn place(&self, node: u32) -> Option<usize> {
        let place = *self.places.get(node as usize)? as usize;
        (self.nodes.get(place) == Some(&node)).then_some(place)
    }

    /// Whether the gradient of the node at this place is wanted.
    pub fn wants(&self, place: usize) -> bool {
        self.marks[place].wanted
    }

    /// Whether the backward pass continues from the node at this place.
    pub fn leads(&self, place: usize) -> bool {
        self.marks[place].leads
    }

    /// Whether the gradient of a node is wanted or leads to a wanted one.
    #[inline]
    pub fn needs(&self, node: u32) -> bool {
        self.place(node).is_some_and(|place| self.marks[place].wanted || self.marks[place].leads)
    }

    /// The memory of this path, for the next one.
    pub fn into_scratch(self) -> Vec<u32> {
        self.places
    }
}
