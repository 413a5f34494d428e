//! Groups of connected items.

/// Groups of items that are connected by pairs. The algorithm is union-find (Galler and Fischer
/// 1964).
#[derive(Debug)]
pub(crate) struct Groups {
    /// For each item, another item of its group that is closer to the group's representative. The
    /// representative refers to itself.
    parents: Vec<u32>,
}

impl Groups {
    /// `n` items that are not connected.
    pub(crate) fn new(n: usize) -> Self {
        Self {
            parents: (0..).take(n).collect(),
        }
    }

    /// Connects two items.
    pub(crate) fn join(&mut self, a: u32, b: u32) {
        let a = self.representative(a);
        let b = self.representative(b);
        // The smaller index becomes the representative, so the representative does not depend on
        // the order of joining.
        self.parents[a.max(b) as usize] = a.min(b);
    }

    /// The representative of an item's group. Shortens the path to it.
    pub(crate) fn representative(&mut self, mut item: u32) -> u32 {
        while self.parents[item as usize] != item {
            // Path halving keeps paths short, so that joining n pairs takes almost linear time.
            let parent = self.parents[item as usize];
            self.parents[item as usize] = self.parents[parent as usize];
            item = parent;
        }
        item
    }
}
