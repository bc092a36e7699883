//! Colours of high dynamic range as sRGB, by filters of ffmpeg.

use super::program::FFMPEG;
use crate::interrupt::Work;

/// The filter that ends with the YUV of JPEG files: BT.601 with full range.
pub const TO_JPEG: &str = "scale=out_color_matrix=bt601:out_range=full";
/// How values change.
pub const MAPPING: &str = "values up to 0.7 of white stay, those up to 5 times white are compressed";

/// Returns true if the installed ffmpeg has the filters.
pub fn can_map() -> Work<bool> {
    let filters = FFMPEG.ask(&["-hide_banner", "-filters"])?;
    Ok(["zscale", "tonemap"].iter().all(|wanted| filters.split_whitespace().any(|word| word == *wanted)))
}

/// The filters from colours, as options of the filter `zscale` describe them, to JPEG.
///
/// White is 1 in linear light, and 203 cd/m2 (ITU-R BT.2408) in other curves.
pub fn map(input: &str) -> String {
    format!(
        "zscale={input}:t=linear:npl=203,format=gbrpf32le,zscale=p=bt709,tonemap=mobius:param=0.7:desat=0:peak=5,\
         zscale=t=iec61966-2-1,format=gbrp,{TO_JPEG}"
    )
}
