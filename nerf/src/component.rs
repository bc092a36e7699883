//! Parts of a model that are chosen by name, here or in any crate: a configuration that knows what it builds.

use crate::space::cube::Space;
use crate::{Error, Result};
use rand::Rng;
use raygrad_autograd::Scalar;
use raygrad_nn::Params;
use serde::de::{DeserializeOwned, Error as _};
use serde::ser::SerializeMap;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::Value;
use std::any::Any;
use std::fmt;
use std::sync::{PoisonError, RwLock};

/// What can be chosen: fields, samplers, or terms of the loss.
pub trait ComponentType: Sized + 'static {
    /// What one of them is called in messages.
    const WHAT: &'static str;
    /// What is built.
    type Built<T: Scalar>: 'static;
}

/// Where something is built, and with what.
pub struct BuildContext<'a, T: Scalar> {
    /// The scene's region.
    pub space: Space,
    /// How many photographs the model is fitted to, for what has numbers of its own for each: 0 if that is not known.
    pub frames: usize,
    /// Where parameters go.
    pub params: &'a mut Params<T>,
    /// What their names begin with: `<name>.table`.
    pub name: &'a str,
    /// Where their first values come from.
    pub rng: &'a mut dyn Rng,
}

impl<T: Scalar> BuildContext<'_, T> {
    /// The same place for a part with another name.
    pub fn child<'b>(&'b mut self, name: &'b str) -> BuildContext<'b, T> {
        BuildContext { space: self.space, frames: self.frames, params: &mut *self.params, name, rng: &mut *self.rng }
    }
}

/// A configuration that can be chosen by its name: of a field (`ComponentConfig<Fields>`) or of a sampler (`ComponentConfig<Samplers>`).
///
/// In a file it is `{"kind": "<KIND>", ..}` with the configuration's own fields. [`register`] makes the name known to
/// whatever reads such files.
pub trait ComponentConfig<F: ComponentType>:
    Serialize + DeserializeOwned + Clone + fmt::Debug + Send + Sync + 'static
{
    /// The name.
    const KIND: &'static str;

    /// Whether the numbers make sense.
    ///
    /// # Errors
    /// If one is out of range.
    fn check(&self) -> Result<()> {
        Ok(())
    }

    /// Builds what is configured, with new parameters.
    ///
    /// # Errors
    /// If it cannot be built of these numbers.
    fn build<T: Scalar>(&self, site: BuildContext<'_, T>) -> Result<F::Built<T>>;
}

/// A [`ComponentConfig`] whose type is known only while the program runs: what a [`Config`](crate::Config) holds.
pub struct AnyConfig<F: ComponentType>(Box<dyn AnyKind<F>>);

impl<F: ComponentType> AnyConfig<F> {
    /// This configuration.
    pub fn new(config: impl ComponentConfig<F>) -> Self {
        AnyConfig(Box::new(config))
    }

    /// Its name.
    pub fn kind(&self) -> &'static str {
        self.0.kind()
    }

    /// The configuration, if it is a `K`.
    pub fn get<K: ComponentConfig<F>>(&self) -> Option<&K> {
        (&*self.0 as &dyn Any).downcast_ref()
    }

    /// The configuration, to be changed, if it is a `K`.
    pub fn get_mut<K: ComponentConfig<F>>(&mut self) -> Option<&mut K> {
        (&mut *self.0 as &mut dyn Any).downcast_mut()
    }

    /// Whether the numbers make sense.
    ///
    /// # Errors
    /// As [`ComponentConfig::check`].
    pub fn check(&self) -> Result<()> {
        self.0.check()
    }

    /// Builds what is configured, with new parameters.
    ///
    /// # Errors
    /// As [`ComponentConfig::check`] and [`ComponentConfig::build`].
    pub fn build<T: Scalar>(&self, site: BuildContext<'_, T>) -> Result<F::Built<T>> {
        self.check()?;
        let BuildContext { space, frames, params, name, rng } = site;
        let params: &mut dyn Any = params;
        let built: Box<dyn Any> = if let Some(params) = params.downcast_mut() {
            Box::new(self.0.single(BuildContext { space, frames, params, name, rng })?)
        } else if let Some(params) = params.downcast_mut() {
            Box::new(self.0.double(BuildContext { space, frames, params, name, rng })?)
        } else {
            return Err(Error::setting(F::WHAT, "can be built in f32 and f64"));
        };
        match built.downcast() {
            Ok(built) => Ok(*built),
            Err(_) => unreachable!("what is built is of the type of its parameters"),
        }
    }
}

/// What a [`ComponentConfig`] does, without its type.
trait AnyKind<F: ComponentType>: Any + fmt::Debug + Send + Sync {
    fn kind(&self) -> &'static str;
    fn check(&self) -> Result<()>;
    fn value(&self) -> serde_json::Result<Value>;
    fn boxed(&self) -> Box<dyn AnyKind<F>>;
    fn single(&self, site: BuildContext<'_, f32>) -> Result<F::Built<f32>>;
    fn double(&self, site: BuildContext<'_, f64>) -> Result<F::Built<f64>>;
}

impl<F: ComponentType, K: ComponentConfig<F>> AnyKind<F> for K {
    fn kind(&self) -> &'static str {
        K::KIND
    }

    fn check(&self) -> Result<()> {
        ComponentConfig::check(self)
    }

    fn value(&self) -> serde_json::Result<Value> {
        serde_json::to_value(self)
    }

    fn boxed(&self) -> Box<dyn AnyKind<F>> {
        Box::new(self.clone())
    }

    fn single(&self, site: BuildContext<'_, f32>) -> Result<F::Built<f32>> {
        self.build(site)
    }

    fn double(&self, site: BuildContext<'_, f64>) -> Result<F::Built<f64>> {
        self.build(site)
    }
}

impl<F: ComponentType> Clone for AnyConfig<F> {
    fn clone(&self) -> Self {
        AnyConfig(self.0.boxed())
    }
}

impl<F: ComponentType> fmt::Debug for AnyConfig<F> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl<F: ComponentType> PartialEq for AnyConfig<F> {
    /// Whether both would be written alike.
    fn eq(&self, other: &Self) -> bool {
        self.kind() == other.kind() && matches!((self.0.value(), other.0.value()), (Ok(a), Ok(b)) if a == b)
    }
}

/// The name of the name.
const KIND: &str = "kind";

impl<F: ComponentType> Serialize for AnyConfig<F> {
    fn serialize<S: Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        use serde::ser::Error;
        let Value::Object(fields) = self.0.value().map_err(S::Error::custom)? else {
            return Err(S::Error::custom(format!("the configuration `{}` is not made of fields", self.kind())));
        };
        let mut map = serializer.serialize_map(Some(1 + fields.len()))?;
        map.serialize_entry(KIND, self.kind())?;
        fields.iter().try_for_each(|(name, value)| map.serialize_entry(name, value))?;
        map.end()
    }
}

impl<'de, F: ComponentType> Deserialize<'de> for AnyConfig<F> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Self, D::Error> {
        let mut fields = serde_json::Map::deserialize(deserializer)?;
        let named = fields.remove(KIND);
        let Some(kind) = named.as_ref().and_then(Value::as_str) else {
            return Err(D::Error::custom(format!("a {} has a field `{KIND}`: its name", F::WHAT)));
        };
        // A copy: what is read may hold parts of its own.
        let all: Vec<Registered<F>> = {
            let registered = REGISTERED.read().unwrap_or_else(PoisonError::into_inner);
            registered.iter().filter_map(|one| one.downcast_ref()).copied().collect()
        };
        let Some((_, read)) = all.iter().find(|(known, _)| *known == kind) else {
            let known: Vec<_> = all.iter().map(|(known, _)| *known).collect();
            let what = format!("there is no {} `{kind}`; known are {}", F::WHAT, known.join(", "));
            let what =
                if known.is_empty() { "nothing is registered but as part of a whole configuration" } else { &what };
            return Err(D::Error::custom(format!("{what}; a program registers what is its own")));
        };
        read(Value::Object(fields)).map_err(|error| D::Error::custom(format!("{} `{kind}`: {error}", F::WHAT)))
    }
}

/// A name of a family, and how to read what it stands for.
type Registered<F> = (&'static str, fn(Value) -> serde_json::Result<AnyConfig<F>>);

/// What was [registered](register): a [`Registered`] each, of all families.
static REGISTERED: RwLock<Vec<Box<dyn Any + Send + Sync>>> = RwLock::new(vec![]);

/// Makes the name of a [`ComponentConfig`] known to whatever reads configurations in this program, beside those of this crate, which
/// [`Config`](crate::Config) knows, and whose names stay theirs: `register::<Fields, MyFieldConfig>()`, once, before the
/// first is read. Who only makes configurations needs it not.
pub fn register<F: ComponentType, K: ComponentConfig<F>>() {
    let one: Registered<F> = (K::KIND, |fields| Ok(AnyConfig::new(serde_json::from_value::<K>(fields)?)));
    REGISTERED.write().unwrap_or_else(PoisonError::into_inner).push(Box::new(one));
}
