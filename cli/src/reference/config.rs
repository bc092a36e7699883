//! `docs/reference/config.md`: every key of `config.json`. Types and descriptions come from the sources, and defaults
//! from the presets. Ranges come from the errors of [`Config::check`] for extreme values.

use std::collections::BTreeSet;
use std::fmt::Write;

use raygrad::nerf::{Error, Model};
use serde_json::{Value, json};

use super::samples::{Keys, Origin, Samples, at};
use super::source::{Field, Sources};
use super::{compare, markdown, wrap};
use crate::run::RunConfig;

/// Titles and introductions of the sections, by name of the struct or enum.
const TITLES: [(&str, &str, &str); 30] = [
    ("RunConfig", "Run", "The keys at the top of `config.json`."),
    ("Scene", "Scene", "A word, or an object with a folder."),
    ("SceneBox", "Scene box", "The region that the model covers."),
    ("SceneTransform", "Scene transform", "scene = `scale * rotation * (capture - origin)`."),
    ("Ndc", "Normalised device coordinates", "The projection of a forward-facing scene."),
    ("Viewpoint", "Viewpoint", "The average training camera."),
    ("Budget", "Budget", "An object with one of these keys."),
    (
        "Config",
        "Model and training",
        "The keys below `config`. Below, and for `--set`, they are written without `config.`",
    ),
    ("ClassicConfig", "Classic field", "The networks of the NeRF paper."),
    ("InstantConfig", "Instant field", "A hash grid, a density network and a colour network."),
    ("VoxelConfig", "Voxel field", "A dense voxel grid without a network."),
    ("HashGridConfig", "Hash grid", "A multiresolution hash grid (Müller et al. 2022)."),
    ("HierarchicalConfig", "Hierarchical sampler", "A coarse network shows where the field is sampled."),
    ("MarchingConfig", "Marching sampler", "Even intervals through the occupied cells of a grid."),
    ("ProposalConfig", "Proposal sampler", "Small density networks show where the field is sampled."),
    ("ProposalLevel", "Proposal network", "One proposal network."),
    ("OccupancyConfig", "Occupancy grid", "The cells that may hold something."),
    ("Skipping", "Empty-space skipping", "What training and views skip. A word sets all keys at once."),
    ("Quadrature", "Quadrature", "A word, or an object for the adaptive rule."),
    ("Loss", "Loss", "The loss of the error `e` of one colour channel. A word, or an object."),
    ("DistortionConfig", "Distortion loss", "Pulls the weights along a ray together, against floaters and fog."),
    ("EntropyConfig", "Entropy loss", "Makes each ray opaque or empty."),
    ("OrientationConfig", "Orientation loss", "Turns normals towards the camera. It makes steps several times slower."),
    ("DepthConfig", "Depth loss", "Fits measured depths."),
    ("TotalVariationConfig", "Total variation loss", "Smooths a table where no image shows it."),
    (
        "Schedule",
        "Schedule",
        "A learning rate over the run, whose `fraction` rises from 0 to 1. An object with one of these keys.",
    ),
    ("AdamConfig", "Adam", "Constants of the Adam optimizer."),
    ("GroupConfig", "Parameter group", "Parameters with Adam constants and a learning rate of their own."),
    (
        "CameraOptimizerConfig",
        "Camera optimizer",
        "Optimization of focal lengths and lenses. The learning rate of poses is the key `poses`.",
    ),
    ("ExposureConfig", "Exposure model", "What is learned of how images show the scene's colours."),
];

fn title(name: &str) -> (&'static str, &'static str) {
    let found = TITLES.iter().find(|(own, ..)| *own == name);
    found.map(|(_, title, text)| (*title, *text)).unwrap_or_else(|| panic!("`{name}` needs a title in TITLES"))
}

/// A struct or an enum, and its paths.
struct Section {
    name: String,
    kind: Option<String>,
    paths: Vec<String>,
}

/// All sections in the order of the page, and the paths of all keys.
struct Schema<'a> {
    sources: &'a Sources,
    sections: Vec<Section>,
    keys: BTreeSet<String>,
}

/// The type within `Option` and `Vec`, and the suffix of its path.
fn inner(ty: &str) -> (&str, &'static str) {
    let ty = ty.strip_prefix("Option<").and_then(|ty| ty.strip_suffix('>')).unwrap_or(ty);
    match ty.strip_prefix("Vec<").and_then(|ty| ty.strip_suffix('>')) {
        Some(ty) => (ty, "[]"),
        None => (ty, ""),
    }
}

/// The component kinds of a type.
fn family(ty: &str) -> Option<&'static str> {
    [("FieldConfig", "Fields"), ("SamplerConfig", "Samplers"), ("LossTermConfig", "LossTerms")]
        .into_iter()
        .find_map(|(own, family)| (own == ty).then_some(family))
}

impl Schema<'_> {
    fn visit(&mut self, name: &str, kind: Option<&str>, path: &str) {
        match self.sections.iter_mut().find(|section| section.name == name) {
            Some(section) => section.paths.push(path.into()),
            None => {
                self.sections.push(Section { name: name.into(), kind: kind.map(Into::into), paths: vec![path.into()] });
            }
        }
        let item = self.sources.get(name).unwrap_or_else(|| panic!("no struct `{name}` in the sources"));
        for field in &item.fields {
            self.field(field, path);
        }
        for variant in item.variants.iter().filter(|variant| item.fields.is_empty() && !is_word(variant)) {
            self.field(variant, path);
            let path = format!("{path}.{}", variant.name);
            variant.fields.iter().for_each(|field| self.field(field, &path));
        }
    }

    fn field(&mut self, field: &Field, path: &str) {
        let path = format!("{path}.{}", field.name);
        let (ty, list) = inner(&field.ty);
        let below = format!("{path}{list}");
        self.keys.insert(path);
        if let Some(family) = family(ty) {
            let kinds = self.sources.kinds.iter().filter(|(_, own, _)| own == family);
            for (kind, _, name) in kinds {
                self.visit(name, Some(kind), &format!("{below}{{{kind}}}"));
            }
        } else if self.sources.get(ty).is_some() && words(self.sources, ty).is_none() {
            self.visit(ty, None, &below);
        }
    }
}

/// Returns true if files hold a variant as a word.
fn is_word(variant: &Field) -> bool {
    variant.ty.is_empty() && variant.fields.is_empty()
}

/// The variants of an enum of words.
fn words<'a>(sources: &'a Sources, ty: &str) -> Option<&'a [Field]> {
    let item = sources.get(ty).filter(|item| item.fields.is_empty() && item.variants.iter().all(is_word))?;
    Some(&item.variants)
}

fn schema(sources: &Sources) -> Schema<'_> {
    let mut schema = Schema { sources, sections: vec![], keys: BTreeSet::new() };
    schema.visit("RunConfig", None, "");
    schema
}

/// Splits a doc comment into description, unit and range.
fn described(doc: &str) -> (String, Option<String>, Option<String>) {
    // Links between items are for rustdoc only.
    let mut text = String::new();
    let mut rest = doc;
    while let Some((before, after)) = rest.split_once('[') {
        text += before;
        match after.split_once(']') {
            Some((label, after)) if label.starts_with('`') || after.starts_with('(') => {
                text += label;
                rest = after.strip_prefix('(').and_then(|a| a.split_once(')')).map_or(after, |(_, after)| after);
            }
            _ => {
                text.push('[');
                rest = after;
            }
        }
    }
    text += rest;
    let take = |text: &mut String, word: &str| {
        let (before, fact) = text.split_once(word)?;
        let (before, fact) = (before.trim().to_owned(), fact.trim().trim_end_matches('.').to_owned());
        *text = before;
        Some(fact)
    };
    let range = take(&mut text, "Range: ");
    let unit = take(&mut text, "Unit: ");
    // Rust names are for rustdoc only, too.
    while let Some((before, after)) = text.split_once(" See `") {
        let rest = after.split_once("`.").map_or("", |(_, rest)| rest).to_owned();
        text = format!("{before}{rest}");
    }
    (text, unit, range)
}

/// The range of a number, from the errors of [`Config::check`] for extreme values.
fn range(path: &str, ty: &str, samples: &[(Origin, Value)]) -> Option<String> {
    let key = path.rsplit('.').next()?;
    let sample = samples.iter().find_map(|(_, sample)| {
        let mut sample = sample.clone();
        at(&mut sample, path).is_some().then_some(sample)
    })?;
    let probes = match ty {
        "usize" | "u32" | "u64" => vec![json!(0), json!(4_000_000_000_u32), json!(1_u64 << 60)],
        "f64" => vec![json!(-1e300), json!(1e300), json!(0.0)],
        _ => return None,
    };
    let mut ranges: Vec<String> = vec![];
    for probe in probes {
        let mut sample = sample.clone();
        *at(&mut sample, path)? = probe;
        let Ok(run) = serde_json::from_value::<RunConfig>(sample) else { continue };
        let refused = match run.check() {
            Ok(()) if path.contains(".grid.") => Model::<f32>::new(run.config, run.scene_box, 0).err(),
            checked => checked.err(),
        };
        let Some(Error::Setting { name, what }) = refused else { continue };
        let found = what.split_once("; use ").map(|(_, range)| range).or_else(|| {
            let must = what.strip_prefix("must be ")?.split_once(", is ")?.0;
            Some(must.strip_prefix("from ").unwrap_or(must))
        });
        if let Some(found) =
            found.filter(|found| name.rsplit('.').next() == Some(key) && !ranges.iter().any(|r| r == found))
        {
            ranges.push(found.to_owned());
        }
    }
    let first = ranges.first()?.clone();
    match first.strip_prefix("0 to ") {
        Some(most) if ranges.iter().any(|range| range == "more than 0") => Some(format!("more than 0, to {most}")),
        _ => Some(first),
    }
}

/// A type in words.
fn type_words(sources: &Sources, ty: &str) -> String {
    if let Some(ty) = ty.strip_prefix("Option<").and_then(|ty| ty.strip_suffix('>')) {
        return format!("{} or null", type_words(sources, ty));
    }
    if let Some(ty) = ty.strip_prefix("Vec<").and_then(|ty| ty.strip_suffix('>')) {
        let words = type_words(sources, ty);
        return match words.as_str() {
            "integer" | "text" => format!("list of {words}s"),
            _ => format!("list of {}", words.replacen("object ", "objects ", 1)),
        };
    }
    if let Some(family) = family(ty) {
        let kinds = sources.kinds.iter().filter(|(_, own, _)| own == family);
        let links: Vec<String> =
            kinds.map(|(kind, _, name)| format!("[`{kind}`](#{})", anchor(title(name).0))).collect();
        return format!("object whose `kind` is {}", links.join(", "));
    }
    match ty {
        "usize" | "u32" | "u64" => "integer".into(),
        "f64" | "f32" | "Duration" => "number".into(),
        "bool" => "true or false".into(),
        "String" | "HoldOut" => "text".into(),
        "PathBuf" => "path".into(),
        "DVec3" => "3 numbers".into(),
        "DMat3" => "9 numbers".into(),
        "[f64; 2]" => "2 numbers".into(),
        "[DVec3; 2]" => "2 points of 3 numbers".into(),
        _ if words(sources, ty).is_some() => "word".into(),
        _ => {
            assert!(sources.get(ty).is_some(), "a type `{ty}` without words");
            let title = title(ty).0;
            format!("[{title}](#{})", anchor(title))
        }
    }
}

fn anchor(title: &str) -> String {
    title.to_lowercase().replace(' ', "-")
}

/// A path in the syntax of `--set`.
fn shown(path: &str) -> String {
    let mut text = String::new();
    let mut is_kind = false;
    for c in path.trim_start_matches(".config").trim_start_matches('.').chars() {
        is_kind = (is_kind || c == '{') && c != '}';
        if !is_kind && c != '}' {
            text.push(c);
        }
    }
    text
}

fn value_words(value: &Value) -> Option<String> {
    match value {
        Value::Object(fields) if fields.contains_key("kind") => Some(format!("`{}`", fields["kind"].as_str()?)),
        // The variant of an enum with fields.
        Value::Object(fields) if fields.len() == 1 && fields.values().all(Value::is_object) => {
            Some(format!("`{value}`"))
        }
        Value::Object(_) => None,
        Value::Array(all) if all.iter().any(Value::is_object) => None,
        Value::String(word) => Some(format!("`{word}`")),
        _ => Some(format!("`{value}`")),
    }
}

/// The defaults of a section's key, as a sentence.
fn defaults(section: &Section, field: &Field, keys: &[(Origin, Keys)]) -> Option<String> {
    let mut parts = vec![];
    for path in &section.paths {
        let full = format!("{path}.{}", field.name);
        let of = |value: &[Value]| value.iter().map(value_words).collect::<Option<Vec<_>>>().map(|all| all.join(", "));
        // Each value with its presets.
        let mut values: Vec<(String, Vec<&str>)> = vec![];
        for (origin, keys) in keys {
            if let (Origin::Preset(name), Some(value)) = (origin, keys.get(&full))
                && full.starts_with(".config")
            {
                let value = of(value)?;
                match values.iter_mut().find(|(other, _)| *other == value) {
                    Some((_, names)) => names.push(name),
                    None => values.push((value, vec![name])),
                }
            }
        }
        let text = match &values[..] {
            [] => {
                let absent = keys.iter().find(|(origin, keys)| *origin == Origin::Absent && keys.contains_key(&full));
                let Some((_, keys)) = absent else { continue };
                of(&keys[&full])?
            }
            [(value, names)] if names.len() == 4 => value.clone(),
            values => {
                let words = values.iter().map(|(value, names)| format!("{value} ({})", names.join(", ")));
                words.collect::<Vec<_>>().join(", ")
            }
        };
        parts.push((shown(path), text));
    }
    let is_file = !section.paths[0].starts_with(".config");
    match &parts[..] {
        [] => None,
        [(_, text)] if is_file => Some(format!("If absent: {text}")),
        [(_, text)] => Some(format!("Default: {text}")),
        parts => {
            let parts: Vec<String> = parts.iter().map(|(path, text)| format!("{text} in `{path}`")).collect();
            Some(format!("Default: {}", parts.join("; ")))
        }
    }
}

/// The entry of a key: its description, then the facts.
fn entry(schema: &Schema<'_>, section: &Section, field: &Field, below: &str, samples: &Samples) -> String {
    let sources = schema.sources;
    let (text, unit, said) = described(&field.doc);
    assert!(!text.is_empty(), "`{}.{}` has no description", section.name, field.name);
    let mut facts = vec![];
    if !field.ty.is_empty() {
        facts.push(format!("Type: {}", type_words(sources, &field.ty)));
    }
    let words = words(sources, inner(&field.ty).0);
    if let Some(words) = words {
        let names: Vec<String> = words.iter().map(|word| format!("`{}`", word.name)).collect();
        facts.push(format!("Values: {}", names.join(", ")));
    }
    facts.extend(unit.map(|unit| format!("Unit: {unit}")));
    let path = format!("{}{below}.{}", section.paths[0], field.name);
    let ty = field.ty.trim_start_matches("Option<").trim_end_matches('>');
    let found = range(&path, ty, &samples.values);
    if let (Some(found), Some(said)) = (&found, &said) {
        // A range that depends on another key names that key.
        assert!(
            found == said || said.contains('`'),
            "{path}: the code asks for `{found}`, the doc comment says `{said}`"
        );
    }
    let any = matches!(ty, "usize" | "u32" | "u64").then(|| "0 or more".to_owned());
    facts.extend(said.or(found).or(any).map(|range| format!("Range: {range}")));
    if below.is_empty() {
        facts.extend(defaults(section, field, &samples.keys));
    }
    if path.starts_with(".config") && !field.ty.is_empty() && !samples.has_default(&path) {
        facts.push("Required".into());
    }
    if !field.aliases.is_empty() {
        let names: Vec<String> = field.aliases.iter().map(|name| format!("`{name}`")).collect();
        facts.push(format!("Earlier name: {}", names.join(", ")));
    }
    let (indent, bullet) = if below.is_empty() { ("  ", "- ") } else { ("    ", "  - ") };
    let mut page = wrap(bullet, indent, &format!("**`{}`**: {}", field.name, markdown(&text)));
    if !facts.is_empty() {
        // A Markdown line break.
        page.insert(page.len() - 1, '\\');
        page += &wrap(indent, indent, &facts.iter().map(|fact| format!("{fact}.")).collect::<Vec<_>>().join(" "));
    }
    for word in words.into_iter().flatten() {
        page += &word_entry(word, &format!("{indent}- "));
    }
    page
}

fn word_entry(word: &Field, bullet: &str) -> String {
    let text = described(&word.doc).0;
    assert!(!text.is_empty(), "`{}` has no description", word.name);
    let indent = " ".repeat(bullet.len());
    let earlier: String = word.aliases.iter().map(|name| format!(" Earlier name: `{name}`.")).collect();
    wrap(bullet, &indent, &format!("`{}`: {}{earlier}", word.name, markdown(&text)))
}

fn page() -> String {
    let sources = Sources::read();
    let (schema, samples) = (schema(&sources), Samples::new());
    let mut page = "# config.json\n\n".to_owned();
    for text in [
        "Each run folder holds a `config.json`: the scene, the cameras and every setting of model and training. \
         `raygrad train --set NAME=VALUE` sets a key below `config`, such as `--set sampler.samples=16384`. Values are JSON. \
         Parts of a path are separated by points; `[]` stands for the elements of a list.",
        "Defaults are those of the presets; one value means that all presets have it. `raygrad train` adapts some to the \
         budget: the size of the hash grid, `color_depth`, `step`, `last_step` and `samples`. For unbounded scenes it also \
         changes `cascades`, `resolution`, `cone` and `view_step`, and adds a distortion loss. Transparent images of a bounded \
         scene change `early_stop_eps`, opaque ones `background`. The number of cores changes `tiles`, and 16 images or \
         fewer change `coarse` and `check_at`.",
        "This page is generated from the program. `UPDATE_SNAPSHOTS=1 cargo test -p raygrad-cli --bin raygrad reference` \
         writes it.",
    ] {
        page += &wrap("", "", text);
        page.push('\n');
    }
    let mut earlier: BTreeSet<(String, String)> = BTreeSet::new();
    for section in &schema.sections {
        let (title, intro) = title(&section.name);
        write!(page, "## {title}\n\n").unwrap();
        let mut intro = intro.to_owned();
        let mut places: Vec<String> = section.paths.iter().map(|path| format!("`{}`", shown(path))).collect();
        places.sort();
        places.dedup();
        if let Some(kind) = &section.kind {
            write!(intro, " Its `kind` is `{kind}`.").unwrap();
        }
        if !matches!(section.name.as_str(), "RunConfig" | "Config") {
            write!(intro, " Used in {}.", places.join(", ")).unwrap();
        }
        page += &wrap("", "", &intro);
        page.push('\n');
        let item = sources.get(&section.name).unwrap();
        let mut remember = |name: &str, fields: &[Field]| {
            for field in fields {
                earlier.extend(field.aliases.iter().map(|old| (old.clone(), format!("{name}{}", field.name))));
            }
        };
        for field in &item.fields {
            page += &entry(&schema, section, field, "", &samples);
        }
        remember("", &item.fields);
        for variant in &item.variants {
            if variant.ty == "earlier" {
                page += &word_entry(
                    &Field { doc: format!("{} Files of earlier versions have it.", variant.doc), ..variant.clone() },
                    "- ",
                );
            } else if let Some(words) = sources.get(&variant.ty).filter(|_| !item.fields.is_empty()) {
                page += "- A word in place of the object:\n";
                words.variants.iter().for_each(|word| page += &word_entry(word, "  - "));
            } else if is_word(variant) {
                page += &word_entry(variant, "- ");
            } else {
                page += &entry(&schema, section, variant, "", &samples);
                for field in &variant.fields {
                    page += &entry(&schema, section, field, &format!(".{}", variant.name), &samples);
                }
            }
        }
        page.push('\n');
    }
    page += "## Keys of earlier versions\n\n";
    page += &wrap("", "", "raygrad reads these keys of files of earlier versions, and writes the new ones.");
    page += "\n| earlier key | key |\n|---|---|\n";
    for (old, new) in earlier {
        writeln!(page, "| `{old}` | `{new}` |").unwrap();
    }
    page
}

#[test]
fn config_page_equals_generated_text() {
    compare("config.md", &page());
}

#[test]
fn config_page_contains_every_key() {
    let sources = Sources::read();
    let schema = schema(&sources);
    let keys: BTreeSet<String> = Samples::new().keys.into_iter().flat_map(|(_, keys)| keys.into_keys()).collect();
    let new: Vec<&String> = keys.difference(&schema.keys).collect();
    assert!(new.is_empty(), "keys that the sources do not have: {new:?}");
    let unseen: Vec<&String> = schema.keys.difference(&keys).collect();
    assert!(unseen.is_empty(), "keys that no sample has, so that their ranges are not looked for: {unseen:?}");
    assert!(keys.len() > 150, "{} keys", keys.len());
    let page = page();
    for key in &schema.keys {
        let name = key.rsplit('.').next().unwrap();
        assert!(page.contains(&format!("**`{name}`**")), "{key}");
    }
}

#[test]
fn config_ranges_equal_those_of_check() {
    let samples = Samples::new().values;
    let range = |path: &str, ty: &str| range(path, ty, &samples);
    assert_eq!(range(".config.field{instant}.grid.levels", "usize").as_deref(), Some("1 to 32"));
    assert_eq!(range(".config.schedule.exponential.to", "f64").as_deref(), Some("1e-30 to 1e30"));
    assert_eq!(range(".keep_checkpoints", "usize").as_deref(), Some("2 to 16384"));
    assert_eq!(range(".config.seed", "u64"), None);
}
