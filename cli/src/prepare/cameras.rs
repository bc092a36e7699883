//! Images that share a camera.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use raygrad::nerf::Result;
use raygrad::nerf::dataset::{Exif, ExifLens, Photo};

/// An image file, without its pixels.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct About {
    lens: Option<ExifLens>,
    /// Width and height.
    size: [usize; 2],
    /// Latitude and longitude in degrees.
    pub place: Option<[f64; 2]>,
}

impl About {
    /// Reads the header of an image file.
    pub fn read(path: &Path) -> Result<Self> {
        let [_, size] = Photo::size_of_file(path)?;
        let Exif { lens, place } = Photo::exif_of_file(path)?;
        Ok(About { lens, size, place })
    }
}

/// Images by number: groups of several that share a camera, and the others.
#[derive(Debug, PartialEq)]
pub struct Cameras {
    pub shared: Vec<Vec<usize>>,
    pub single: Vec<usize>,
}

/// Groups images by lens and size. Images without EXIF data share a camera if all of them have one size, or that size
/// turned: as portraits and landscapes.
pub fn group(images: &[About]) -> Cameras {
    let mut groups: BTreeMap<(&Option<ExifLens>, [usize; 2]), Vec<usize>> = BTreeMap::new();
    for (i, image) in images.iter().enumerate() {
        groups.entry((&image.lens, image.size)).or_default().push(i);
    }
    let unknown = groups.keys().filter(|(lens, _)| lens.is_none());
    let is_one_size = unknown.map(|(_, [w, h])| [w.min(h), w.max(h)]).collect::<BTreeSet<_>>().len() == 1;
    let is_shared = |lens: &Option<ExifLens>, group: &[usize]| group.len() > 1 && (lens.is_some() || is_one_size);
    let mut cameras = Cameras { shared: vec![], single: vec![] };
    for ((lens, _), group) in groups {
        if is_shared(lens, &group) { cameras.shared.push(group) } else { cameras.single.extend(group) }
    }
    cameras.shared.sort();
    cameras.single.sort();
    cameras
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn group_separates_lenses_and_sizes() {
        let image = |lens: Option<u32>, size| {
            let lens = lens.map(|focal_35mm| ExifLens { focal_35mm, ..ExifLens::default() });
            About { lens, size, place: None }
        };
        let [wide, tall] = [[4, 3], [3, 4]];
        let grouped = |images: &[(Option<u32>, [usize; 2])]| {
            let images: Vec<About> = images.iter().map(|(lens, size)| image(*lens, *size)).collect();
            let Cameras { shared, single } = group(&images);
            (shared, single)
        };
        let [ultra, normal] = [Some(13), Some(26)];
        assert_eq!(
            grouped(&[(normal, wide), (ultra, wide), (normal, tall), (normal, wide), (ultra, wide), (Some(77), wide)]),
            (vec![vec![0, 3], vec![1, 4]], vec![2, 5])
        );
        // Without EXIF data, images share a camera if they have one size, or that size turned.
        assert_eq!(grouped(&[(None, wide), (None, wide), (None, wide)]), (vec![vec![0, 1, 2]], vec![]));
        assert_eq!(grouped(&[(None, wide), (None, tall), (None, wide)]), (vec![vec![0, 2]], vec![1]));
        assert_eq!(grouped(&[(None, wide), (None, [8, 3]), (None, wide)]), (vec![], vec![0, 1, 2]));
        assert_eq!(
            grouped(&[(None, wide), (normal, tall), (None, wide), (normal, tall)]),
            (vec![vec![0, 2], vec![1, 3]], vec![])
        );
    }
}
