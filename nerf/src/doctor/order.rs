//! Orders in which images and poses may have been listed.

/// A difference between the order of the images and the order of their poses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Order {
    /// Each image has the pose of the one before it.
    Late,
    /// Each image has the pose of the one after it.
    Early,
    /// The poses are in reverse.
    Reversed,
    /// The images were sorted as text (`10` before `2`), and the poses by number.
    AsText,
    /// The images were sorted by number, and the poses as text.
    ByNumber,
}

impl Order {
    /// All of them.
    pub const ALL: [Order; 5] = [Order::Late, Order::Early, Order::Reversed, Order::AsText, Order::ByNumber];

    /// For each image, the index of the image that has its pose. `None` if the order is the listed one.
    pub fn poses(self, names: &[&str]) -> Option<Vec<usize>> {
        let count = names.len();
        let poses: Vec<usize> = match self {
            Order::Late => (0..count).map(|i| (i + 1) % count).collect(),
            Order::Early => (0..count).map(|i| (i + count - 1) % count).collect(),
            Order::Reversed => (0..count).rev().collect(),
            Order::AsText | Order::ByNumber => {
                let [mut as_text, mut by_number] = [(0..count).collect::<Vec<_>>(), (0..count).collect()];
                as_text.sort_by_key(|&i| names[i]);
                by_number.sort_by_cached_key(|&i| pieces(names[i]));
                let (own, others) = if self == Order::AsText { (by_number, as_text) } else { (as_text, by_number) };
                let mut poses = vec![0; count];
                own.into_iter().zip(others).for_each(|(image, pose)| poses[image] = pose);
                poses
            }
        };
        (!poses.is_sorted()).then_some(poses)
    }

    /// The order of the poses.
    pub fn text(self) -> &'static str {
        match self {
            Order::Late => "one image late",
            Order::Early => "one image early",
            Order::Reversed => "in reverse",
            Order::AsText => "in the order of the numbers in the names, and the images in that of the text",
            Order::ByNumber => "in the order of the text of the names, and the images in that of the numbers",
        }
    }
}

/// The texts of a name, each with the number after it.
fn pieces(name: &str) -> Vec<(&str, u128)> {
    let mut pieces = vec![];
    let mut rest = name;
    while !rest.is_empty() {
        let digits = rest.find(|c: char| c.is_ascii_digit()).unwrap_or(rest.len());
        let (text, numbered) = rest.split_at(digits);
        let end = numbered.find(|c: char| !c.is_ascii_digit()).unwrap_or(numbered.len());
        let (number, after) = numbered.split_at(end);
        pieces.push((text, number.parse().unwrap_or(u128::MAX)));
        rest = after;
    }
    pieces
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_get_the_poses_of_the_order() {
        let names = ["b/1.png", "b/2.png", "b/10.png", "b/11.png"];
        let poses = |order: Order| order.poses(&names).unwrap();
        assert_eq!(poses(Order::Late), [1, 2, 3, 0]);
        assert_eq!(poses(Order::Early), [3, 0, 1, 2]);
        assert_eq!(poses(Order::Reversed), [3, 2, 1, 0]);
        // As text: 1, 10, 11, 2. So `10` had the second pose, which is that of `2`.
        assert_eq!(poses(Order::AsText), [0, 2, 3, 1]);
        assert_eq!(poses(Order::ByNumber), [0, 3, 1, 2]);
    }

    #[test]
    fn equal_orders_change_nothing() {
        let names = ["a01.png", "a02.png", "a10.png"];
        assert_eq!(Order::AsText.poses(&names), None);
        assert_eq!(Order::ByNumber.poses(&names), None);
        assert_eq!(Order::Late.poses(&names[..1]), None);
        assert_eq!(Order::Reversed.poses(&[]), None);
    }

    #[test]
    fn numbers_in_names_are_compared_as_numbers() {
        assert_eq!(pieces("IMG_007b12"), [("IMG_", 7), ("b", 12)]);
        assert!(pieces("a9.png") < pieces("a10.png") && pieces("a1b2") < pieces("a1b11"));
        assert!(pieces("") < pieces("x") && pieces(&"9".repeat(60)) == [("", u128::MAX)]);
    }
}
